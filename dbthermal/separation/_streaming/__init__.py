"""Separation of frames as they come: the stream, what it remembers, and compiled arithmetic."""
