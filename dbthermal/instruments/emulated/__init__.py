"""Emulated devices: what stands in for the rig where there is none.

Each module here answers below a real driver, byte for byte where the protocol is public, and reads
and writes one shared `dbthermal.instruments.emulated.world.World`. Nothing here is hardware, and
all of it says so: `is_simulated` is True, and every name and identity holds "emulated". The
emulators were built from public descriptions and checked against public byte vectors; what a real
device does beyond these, they do not know.

The emulators know nothing of how a scene looks: the frame source is handed the pictures, so that
the physics stays below and a program chooses what the emulated cameras see.
"""
