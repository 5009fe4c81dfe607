"""The rig: cameras, filter wheel, thermocouples, and the recording of a capture.

A device has one name like an address, ``serial:///dev/ttyACM0`` or ``sim://boson``, and a driver
that speaks its protocol. Messages are made from bytes, and back, without any input or output, and
below the real drivers `emulated` answers in place of the hardware, and says so:

- `camera`: the interface of any camera, and the state of its shutter; `boson` over `fslp` and its
  `telemetry`, on the frames of `v4l2`;
- `filterwheel` over `apt`; `tc08`, with `thermocouple` for type T; byte streams by `transport`;
- `inventory`: the devices that are plugged in, and missing permissions;
- `session`: the description of a recording; `devices` opens its devices, `protocols` use them;
- `recording`: writes it, and opens it again; `live` shows it meanwhile.

The drivers were written from public descriptions of the protocols and tested against public byte
vectors and emulators, never against hardware. The modules that talk to a device need the optional
packages of ``dbthermal[instruments]``; importing this package loads none of them.
"""
