"""Studies of effects that the model lacks, and changes of cameras."""
