"""The frames of a camera: what any gives (`source`), those of V4L2, and the telemetry in them.

Nothing is imported here: `v4l2_calls` is for Linux only.
"""
