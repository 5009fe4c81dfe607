"""Two cameras side by side, which see one reflection at two places of the object."""
