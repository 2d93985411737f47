"""Training of the network: surfaces, augmentation, rendering, training, evaluation, export."""
