"""The reproduction of the paper: its scenes, experiments and tables."""
