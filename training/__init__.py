"""What makes the weights: surfaces, augmentation, rendering, training, evaluation, export."""
