"""Emulated devices: the other end of the real drivers' lines, for ``sim://`` addresses.

Begin with `world`, the one bench that all of them share: `boson`, `apt` and `tc08` answer as the
devices do, byte for byte where the protocol is public, over a `line`; `camera` gives the
frames, of pictures that a program hands it, or of a blackbody. All say that they are
emulated. They were built from public descriptions; real devices may do more than these say.
"""
