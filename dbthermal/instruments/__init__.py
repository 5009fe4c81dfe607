"""The rig: cameras, filter wheel, thermocouples, and the recording of a capture.

A device has one name like an address, ``serial:///dev/ttyACM0`` or ``sim://boson``, and a driver
that speaks its protocol. What turns bytes into messages does no input or output at all, and below
the real drivers `emulated` answers in place of the hardware, and says so:

- `boson` over `fslp`, `filterwheel` over `apt`: both on the byte streams of `transport`, which
  `dialogue` notes and plays back; `tc08`, with `thermocouple` for type T;
- `video`: the frames, by V4L2, with their telemetry;
- `inventory`: what is plugged in, and what stands in the way;
- `session` of `entries`: what is to be recorded; `devices` opens its `rig`, `protocols` use it;
- `recording`: how that is written, and opened again.

Each device, line and emulator is closed as `closing` says. The drivers were written from public
descriptions of the protocols and tested against public byte vectors and emulators, never against
hardware. The modules that talk to a device need the optional packages of
``dbthermal[instruments]``; importing this package loads none of them.
"""
