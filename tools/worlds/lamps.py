"""Lights of real places for the traced scenes: sky, softboxes, window, ring, lamps, flashes.

The frame is the face's. Each emitter is traced apart with white light of strength 1 (a Lambert surface that
faces a lamp at the origin reflects its albedo as radiance) and gets its colour and strength when the parts of
a rig are added.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from scan2albedo.core.arrays import FloatArray, smoothstep
from scan2albedo.synthetic.renderer import toward

Color = tuple[float, float, float]
WHITE: Color = (1.0, 1.0, 1.0)
WARM: Color = (1.25, 0.98, 0.66)
COOL: Color = (0.86, 1.0, 1.18)
HARD_DEG = 6.0
"""Lamps of a smaller radius, seen from the face, cast shadows with edges."""


def overcast(directions: FloatArray) -> FloatArray:
    """Return radiance (N, 3) of an overcast sky (CIE: thrice as bright above) over dark, brown ground."""
    up = np.clip(directions[:, 1:2], -1, 1)
    sky = (1 + 2 * np.maximum(up, 0)) / 3 * np.array([1.35, 1.45, 1.6])
    return _over_ground(sky, (0.20, 0.17, 0.13), up)


def clear_sky(directions: FloatArray) -> FloatArray:
    """Return radiance (N, 3) of a blue sky, pale at the horizon, over sunlit ground."""
    up = np.clip(directions[:, 1:2], -1, 1)
    blue, pale = np.array([0.55, 0.95, 1.75]), np.array([1.15, 1.35, 1.55])
    sky = blue + (pale - blue) * np.exp(-np.maximum(up, 0) / 0.25)
    return _over_ground(sky, (0.75, 0.68, 0.52), up)


def _over_ground(sky: FloatArray, ground: Color, up: FloatArray) -> FloatArray:
    return sky + (np.array(ground) - sky) * smoothstep((0.03 - up) / 0.1)


def dim_room(directions: FloatArray) -> FloatArray:
    """Return radiance (N, 3) of a room by its own light: white ceiling, one warm wall, a wooden floor."""
    x, y, _ = directions.T
    walls = np.full((len(x), 3), 0.95)
    warm = smoothstep((x - 0.35) / 0.3)[:, None]
    walls = walls + warm * (np.array([1.15, 0.80, 0.55]) - walls)
    ceiling, floor = smoothstep((y - 0.5) / 0.25)[:, None], smoothstep((-0.45 - y) / 0.25)[:, None]
    light = walls + ceiling * (np.array([1.7, 1.7, 1.65]) - walls)
    return light + floor * (np.array([0.45, 0.33, 0.22]) - light)


def uniform(directions: FloatArray) -> FloatArray:
    """Return radiance 1 (N, 3) from everywhere."""
    return np.ones_like(directions)


ENVIRONMENTS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "uniform": uniform,
    "overcast": overcast,
    "clear_sky": clear_sky,
    "dim_room": dim_room,
}


@dataclass(frozen=True)
class Environment:
    """Light from everywhere, by its name in `ENVIRONMENTS`."""

    path_factor: ClassVar[float] = 1.0
    """Paths relative to those that are asked for."""
    kind: str

    def plugins(self, mitsuba: Any) -> dict[str, Any]:
        """Return Mitsuba's emitters. Smooth light is best sampled by the BSDF: the emitter picked is dark."""
        transform = mitsuba.ScalarTransform4f
        picture = mitsuba.Bitmap(environment_map(self.kind).astype(np.float32))
        sky = {"type": "envmap", "bitmap": picture, "sampling_weight": 0.0, "to_world": transform()}
        dark = {"type": "point", "position": [0, 0, 1e4], "intensity": {"type": "rgb", "value": 0.0}}
        return {"sky": sky, "dark": dark}


def environment_map(kind: str | Callable[[FloatArray], FloatArray], rows: int = 128) -> FloatArray:
    """Return (rows, 2 rows, 3) as Mitsuba's envmap wants it: +y above, left edge -z, +x a quarter in.

    `kind` is a name in `ENVIRONMENTS`, or gives the radiance (N, 3) from directions (N, 3).
    """
    column, row = np.meshgrid(np.arange(2 * rows), np.arange(rows))
    # Mitsuba wraps the last column onto the first one and puts the poles on the first and last row.
    azimuth, polar = 2 * np.pi * column / (2 * rows - 1), np.pi * row / (rows - 1)
    directions = np.stack(
        [np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)], -1
    )
    radiance = ENVIRONMENTS[kind] if isinstance(kind, str) else kind
    return radiance(directions.reshape(-1, 3)).reshape(rows, 2 * rows, 3)


@dataclass(frozen=True)
class Lamp:
    """A disc, or a rectangle, that shines toward the origin.

    `azimuth_deg` runs from +z toward +x, `elevation_deg` toward +y. `half_mm` holds a disc's radius, or half
    a rectangle's width and height.
    """

    azimuth_deg: float
    elevation_deg: float
    distance_mm: float
    half_mm: tuple[float, ...]

    @property
    def path_factor(self) -> float:
        """Paths relative to those of an environment: small lamps make little noise."""
        return 0.25 if self.radius_deg < HARD_DEG else 0.5

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector from the origin."""
        return toward(self.azimuth_deg, self.elevation_deg)

    @property
    def area_mm2(self) -> float:
        """Of the shining side."""
        if len(self.half_mm) == 1:
            return float(np.pi * self.half_mm[0] ** 2)
        return 4 * self.half_mm[0] * self.half_mm[1]

    @property
    def radius_deg(self) -> float:
        """Of the disc of the same area, seen from the origin."""
        return float(np.rad2deg(np.arctan(np.sqrt(self.area_mm2 / np.pi) / self.distance_mm)))

    def plugins(self, mitsuba: Any) -> dict[str, Any]:
        """Return Mitsuba's area light; its radiance pi d^2 / A gives the irradiance pi at the origin."""
        transform = mitsuba.ScalarTransform4f
        width, height = (self.half_mm * 2)[:2]
        position = (self.distance_mm * self.direction).tolist()
        radiance = float(np.pi * self.distance_mm**2 / self.area_mm2)
        look = transform().look_at(origin=position, target=[0, 0, 0], up=[0, 1, 0])
        shape = {
            "type": "disk" if len(self.half_mm) == 1 else "rectangle",
            "to_world": look @ transform().scale([width, height, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        }
        return {"lamp": shape}


@dataclass(frozen=True)
class WindowedRoom:
    """A room of 3.4 x 2.6 x 3.8 m around the head; a window on the left (-x) alone lights its walls."""

    path_factor: ClassVar[float] = 2.0
    """Light from walls is noisy."""

    def plugins(self, mitsuba: Any) -> dict[str, Any]:
        """Return walls and window as Mitsuba's shapes."""
        plugins = {}
        for name, inward, up, distance, half, color in _WALLS:
            diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}}
            wall = _rectangle(mitsuba, -distance * np.array(inward), inward, up, half)
            plugins[name] = wall | {"bsdf": {"type": "twosided", "b": diffuse}}
        shine = {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}
        window = _rectangle(mitsuba, _WINDOW_MM, [1, 0, 0], [0, 1, 0], (750.0, 650.0))
        plugins["window"] = window | {"emitter": shine}
        return plugins


_WINDOW_MM = np.array([-1695.0, 250.0, 500.0])
"""Middle of the window, 5 mm before its wall."""
_Y, _Z = [0, 1, 0], [0, 0, 1]
_WALLS = (
    ("left", [1, 0, 0], _Y, 1700.0, (1900.0, 1300.0), (0.75, 0.74, 0.70)),
    ("right", [-1, 0, 0], _Y, 1700.0, (1900.0, 1300.0), (0.62, 0.36, 0.24)),
    ("ceiling", [0, -1, 0], _Z, 1300.0, (1700.0, 1900.0), (0.85, 0.85, 0.84)),
    ("floor", [0, 1, 0], _Z, 1300.0, (1700.0, 1900.0), (0.38, 0.25, 0.15)),
    ("front", [0, 0, -1], _Y, 1900.0, (1700.0, 1300.0), (0.55, 0.60, 0.55)),
    ("back", [0, 0, 1], _Y, 1900.0, (1700.0, 1300.0), (0.70, 0.70, 0.72)),
)
"""Of each wall: name, direction into the room, upward in its plane, distance in mm, half sizes, albedo."""


def _rectangle(mitsuba: Any, center: FloatArray, inward: list, up: list, half: tuple) -> dict[str, Any]:
    """Return a rectangle that faces into the room."""
    transform = mitsuba.ScalarTransform4f
    look = transform().look_at(origin=center.tolist(), target=(center + inward).tolist(), up=up)
    return {"type": "rectangle", "to_world": look @ transform().scale([*half, 1])}


Emitter = Environment | Lamp | WindowedRoom


@dataclass(frozen=True)
class Part:
    """One emitter of a rig; `strength` is the radiance of a white Lambert surface that faces a lamp."""

    emitter: Emitter
    strength: float
    color: Color = WHITE

    @property
    def linear(self) -> FloatArray:
        """(3,) strength times colour."""
        return self.strength * np.asarray(self.color)


@dataclass(frozen=True)
class Rig:
    """A light: its name and its parts."""

    name: str
    parts: tuple[Part, ...]

    def lamps(self) -> list[dict[str, Any]]:
        """Return what is known about its lamps, for the truth."""
        return [
            {
                "direction": part.emitter.direction.round(6).tolist(),
                "distance_mm": part.emitter.distance_mm,
                "radius_deg": round(part.emitter.radius_deg, 3),
                "hard": part.emitter.radius_deg < HARD_DEG,
                "strength_linear": part.linear.round(4).tolist(),
            }
            for part in self.parts
            if isinstance(part.emitter, Lamp)
        ]


def _room(strength: float, color: Color = WHITE) -> Part:
    return Part(Environment("dim_room"), strength, color)


def _softbox(azimuth_deg: float, elevation_deg: float, strength: float, color: Color = WHITE) -> Part:
    return Part(Lamp(azimuth_deg, elevation_deg, 1500.0, (350.0, 350.0)), strength, color)


def _flash(azimuth_deg: float, elevation_deg: float, distance_mm: float, strength: float = 1.0) -> Part:
    return Part(Lamp(azimuth_deg, elevation_deg, distance_mm, (14.0,)), strength)


def rigs() -> tuple[Rig, ...]:
    """Return the lights of the set; a raw scan stands in the one that its recipe names.

    All but the dome, the sky and the window have a dim room around; "window" is on the left of a room with
    coloured walls, "lamp_room" a bulb above on the right, "ring" eight lamps around the camera.
    """
    six = ((0, 45), (60, 10), (-60, 10), (35, -35), (-35, -35), (180, 50))
    clear_day = Part(Environment("clear_sky"), 0.28)
    ring = [
        Part(Lamp(24 * np.cos(a), 5 + 24 * np.sin(a), 950.0, (30.0,)), 0.125)
        for a in 2 * np.pi * np.arange(8) / 8
    ]
    return (
        Rig("dome", (Part(Environment("uniform"), 1.0),)),
        Rig("sky", (Part(Environment("overcast"), 1.0),)),
        Rig("softboxes6", (*(_softbox(a, e, 0.3, COOL if a > 0 else WHITE) for a, e in six), _room(0.12))),
        Rig("softboxes2", (_softbox(-42, 18, 0.7), _softbox(48, 10, 0.4, WARM), _room(0.10))),
        Rig("softbox_side", (Part(Lamp(68, 12, 1100.0, (600.0, 700.0)), 1.0), _room(0.14))),
        Rig("window", (Part(WindowedRoom(), 1.0, COOL),)),
        Rig("ring", (*ring, _room(0.08))),
        Rig("lamp_room", (Part(Lamp(-48, 38, 1800.0, (45.0,)), 0.9, WARM), _room(0.30, WARM))),
        Rig("flash", (_flash(14, 8, 1000.0), _room(0.12, WARM))),
        Rig("flash_near", (_flash(-22, 12, 600.0), _room(0.10))),
        Rig("flashes2", (_flash(40, 12, 800.0, 0.8), _flash(-38, 8, 800.0, 0.55), _room(0.08))),
        Rig("sun", (Part(Lamp(35, 42, 10_000.0, (50.0,)), 1.3, (1.12, 1.0, 0.82)), clear_day)),
    )


def rig_named(name: str) -> Rig:
    """Return the rig of a name."""
    return next(rig for rig in rigs() if rig.name == name)
