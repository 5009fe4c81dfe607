"""Emulated devices: what is at the other end of the drivers' lines, for ``sim://`` addresses.

Begin with `world`, the bench that all of them share. `camera` and `apt` answer as the devices do,
byte for byte where the protocol is public, and `tc08` as the vendor's library does; `camera` gives
frames, too. All say that they are emulated. They were built from public descriptions; real devices
may do more than these say.
"""
