"""Completion: values where the separation has none, from what else is known of the scene."""
