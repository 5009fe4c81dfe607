"""The shared state of the emulated bench: one world that all emulators read and write.

The wheel's emulator turns `World.wheel_position`, and what the camera behind it sees changes; the
camera's emulator starts a flat-field correction, and the frame source freezes; a program sets
`World.blackbody_temperature`, and the thermocouples and the frames follow. There is no physics
here, only who is where and how warm. All temperatures are in kelvin, all times in seconds since
the world began, on the clock that was injected; what happens in the scene has a time of its own,
`World.scene_time`, so that a recording can begin with it.
"""

import math
import threading
import time as system_time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

POSITIONS: Final = 6
"""Slots of the wheel, numbered from 1."""

ROOM: Final = 296.15
"""Temperature of all that nobody set [K]."""

FPA: Final = 308.15
"""Temperature of a focal-plane array that nobody set [K]."""

FFC_DURATION: Final = 0.5
"""How long an emulated flat-field correction takes [s]; the real one is not documented publicly."""


@dataclass
class CameraState:
    """
    What one emulated camera is about; plain attributes, to be read and set by emulators.

    Attributes
    ----------
    serial_number : int
        Of the camera.
    fpa_temperature : float
        Of its focal-plane array [K].
    plugged : bool
        False once it was pulled out.
    streaming : bool
        False while its sensor takes no frames: it boots, or waits for pulses that do not come.
    frame_count : int
        Frames since its sensor started.
    ffc_count : int
        Flat-field corrections started.
    ffc_until : float
        When the last one ends [s]; in the past, or -inf, if none is in progress.
    last_ffc_frame : int
        `frame_count` at the start of the last one, 0 before the first.
    last_ffc_temperature : float
        `fpa_temperature` at the start of the last one [K].
    """

    serial_number: int
    fpa_temperature: float = FPA
    plugged: bool = True
    streaming: bool = True
    frame_count: int = 0
    ffc_count: int = 0
    ffc_until: float = -math.inf
    last_ffc_frame: int = 0
    last_ffc_temperature: float = FPA


class World:
    """
    One emulated bench: wheel, blackbody, scene and cameras, on one clock.

    Single attributes may be read and set from any thread. Who changes several together holds
    `lock`, which is re-entrant, or calls a method, which does.

    Parameters
    ----------
    clock : callable
        Gives the time [s]; injected by tests.
    filters : mapping, optional
        Band in each slot of the wheel, by its number 1 to 6. Slots left out hold no filter.
    wheel_position : int
        The slot in the beam at the start.
    blackbody_temperature : float
        Of the blackbody [K].
    time_constant : float
        With which the blackbody approaches what it is set to [s]; 0 is at once.
    scene : callable, optional
        Temperatures of what is in the scene [K], by name, at a time of the scene [s]; by default
        none.
    waits : bool
        Whether the scene stands at its beginning until `begin`; else it begins with the world.

    Attributes
    ----------
    thermocouples : dict
        What each channel, 1 to 8, of the thermocouple logger is at: a name in `scene`, or
        ``"blackbody"``, ``"room"`` or ``"open"``.
    cameras : dict
        `CameraState` of each camera by its name; see `add_camera`.
    epoch : float
        When the world began, on its clock [s].
    scene_began : float
        When the scene began, on the world's clock [s]; infinite before.
    is_simulated : bool
        True.

    Raises
    ------
    ValueError
        If a slot is not 1 to 6, or the time constant is negative.
    """

    is_simulated: Final = True

    def __init__(
        self,
        *,
        clock: Callable[[], float] = system_time.monotonic,
        filters: Mapping[int, str] | None = None,
        wheel_position: int = 1,
        blackbody_temperature: float = ROOM,
        time_constant: float = 0.0,
        scene: Callable[[float], Mapping[str, float]] | None = None,
        waits: bool = False,
    ) -> None:
        if not 0 <= time_constant < math.inf:
            raise ValueError(f"Invalid time_constant {time_constant} s. Must be 0 or more.")
        self.lock = threading.RLock()
        self.clock = clock
        self.filters = {_slot(slot): name for slot, name in (filters or {}).items()}
        self.thermocouples: dict[int, str] = {}
        self.cameras: dict[str, CameraState] = {}
        self._scene = scene
        self._wheel: int | None = _slot(wheel_position)
        self.epoch = clock()
        self.scene_began = math.inf if waits else self.epoch
        self._time_constant = time_constant
        self._blackbody = blackbody_temperature, 0.0, self.epoch  # goal, distance from it, when

    @property
    def time(self) -> float:
        """Time since the world began [s]."""
        return self.clock() - self.epoch

    def begin(self) -> None:
        """Let the scene begin now, or anew."""
        self.scene_began = self.clock()

    def scene_time(self, time: float | None = None) -> float:
        """
        Time since the scene began.

        Parameters
        ----------
        time : float, optional
            When, since the world began [s]; now, unless given.

        Returns
        -------
        float
            [s]; 0 before it began.
        """
        now = self.time if time is None else time
        return max(0.0, self.epoch + now - self.scene_began)

    @property
    def blackbody_temperature(self) -> float:
        """Temperature of the blackbody [K]; set, it goes there with the time constant."""
        goal, distance, since = self._blackbody
        if distance == 0 or self._time_constant == 0:
            return goal
        return goal + distance * math.exp((since - self.clock()) / self._time_constant)

    @blackbody_temperature.setter
    def blackbody_temperature(self, goal: float) -> None:
        self._blackbody = goal, self.blackbody_temperature - goal, self.clock()

    @property
    def wheel_position(self) -> int | None:
        """Slot in the beam, 1 to 6; None while the wheel turns, between two slots."""
        return self._wheel

    @wheel_position.setter
    def wheel_position(self, position: int | None) -> None:
        self._wheel = None if position is None else _slot(position)

    @property
    def filter_name(self) -> str | None:
        """Band of the filter in the beam; None between two slots, or where the slot is empty."""
        position = self._wheel
        return None if position is None else self.filters.get(position)

    def scene_temperatures(self, time: float | None = None) -> dict[str, float]:
        """
        Temperatures of what is in the scene.

        Parameters
        ----------
        time : float, optional
            When, since the world began [s]; now, unless given.

        Returns
        -------
        dict
            Name to temperature [K]; always with ``"blackbody"`` and ``"room"``.
        """
        scene = {} if self._scene is None else self._scene(self.scene_time(time))
        return {"room": ROOM, **scene, "blackbody": self.blackbody_temperature}

    def thermocouple_temperature(self, channel: int) -> float:
        """
        Temperature of the tip of one thermocouple.

        Parameters
        ----------
        channel : int
            Of the logger, see `thermocouples`.

        Returns
        -------
        float
            Temperature [K]; NaN if it is open or there is none.

        Raises
        ------
        KeyError
            If it is at something that the scene does not have.
        """
        place = self.thermocouples.get(channel, "open")
        if place == "open":
            return math.nan
        temperatures = self.scene_temperatures()
        if place not in temperatures:
            raise KeyError(
                f"Unknown place '{place}' of thermocouple {channel}. "
                f"Must be one of {sorted(temperatures)}."
            )
        return temperatures[place]

    def add_camera(self, name: str, serial_number: int) -> CameraState:
        """
        Put a camera on the bench.

        Parameters
        ----------
        name : str
            Its name.
        serial_number : int
            Its number.

        Returns
        -------
        CameraState
            Its state, also in `cameras`.

        Raises
        ------
        ValueError
            If there is one of this name.
        """
        with self.lock:
            if name in self.cameras:
                raise ValueError(f"Repeated camera '{name}'. Each must have a name of its own.")
            self.cameras[name] = CameraState(serial_number)
            return self.cameras[name]

    def camera(self, name: str) -> CameraState:
        """
        State of a camera.

        Parameters
        ----------
        name : str
            Its name.

        Returns
        -------
        CameraState
            Its state, shared by all emulators.

        Raises
        ------
        KeyError
            If there is none of this name.
        """
        if name not in self.cameras:
            raise KeyError(f"Unknown camera '{name}'. Must be one of {sorted(self.cameras)}.")
        return self.cameras[name]

    def start_ffc(self, name: str, duration: float = FFC_DURATION) -> None:
        """
        Start a flat-field correction: the shutter closes, the image freezes until it is over.

        Parameters
        ----------
        name : str
            Of the camera. If one is in progress, it begins anew.
        duration : float
            How long it takes [s].

        Raises
        ------
        KeyError
            If there is no such camera.
        """
        with self.lock:
            state = self.camera(name)
            state.ffc_count += 1
            state.ffc_until = self.time + duration
            state.last_ffc_frame = state.frame_count
            state.last_ffc_temperature = state.fpa_temperature

    def ffc_in_progress(self, name: str) -> bool:
        """
        Whether a camera's shutter is closed.

        Parameters
        ----------
        name : str
            Of the camera.

        Returns
        -------
        bool
            True until its flat-field correction is over.

        Raises
        ------
        KeyError
            If there is no such camera.
        """
        return self.time < self.camera(name).ffc_until


def _slot(position: int) -> int:
    """Return the position if it is one."""
    if position not in range(1, POSITIONS + 1):
        raise ValueError(f"Invalid filter position {position}. Must lie in 1 to {POSITIONS}.")
    return position
