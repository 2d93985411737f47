"""The command `heliotwin`: one file a group of verbs."""
