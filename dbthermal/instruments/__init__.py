"""The rig: cameras, filter wheel, thermocouples, and the recording of a capture.

A device has one name like an address, ``serial:///dev/ttyACM0`` or ``sim://boson``, and a driver
in a module of its own that speaks its protocol through `dbthermal.instruments.transport`. What
turns bytes into messages (`fslp`, `apt`) does no input or output at all. Below the real drivers,
`dbthermal.instruments.emulated` answers in place of the hardware, and says so.

The drivers were written from public descriptions of the protocols and tested against public byte
vectors and emulators, never against hardware. The modules that talk to a device need the optional
packages of ``dbthermal[instruments]``; importing this package loads none of them.
"""
