"""A person's own videos as a data set: looked at once, cut into clips, kept in a recording. `source` needs PyTorch."""
