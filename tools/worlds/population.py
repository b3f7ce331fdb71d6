"""Synthetic people who are hard to tell apart, scanned several times, for recognition."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.lights import PointLight
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.synthetic import Material, Scanner, SyntheticTruth
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.glossy_person import Individual
from scan2albedo.synthetic.raw_scan import scan_of
from scan2albedo.synthetic.sitter import sit_down
from scan2albedo.synthetic.textures import paint_face
from worlds.rooms import random_colors, random_room, room_light_on

_LIGHT_DISTANCE_MM = (700.0, 1500.0)
"""Range of the lights' distance."""
_HIGHLIGHT = (0.05, 0.15)
"""Range of the highlight's strength."""
_FLASH = (1.5, 4.0)
"""Range of the intensity of flashes, their ambient light being 1 on average."""
_ROOM_LAMP = (0.3, 1.0)
"""Range of the intensity of a room's lamp."""
_TWO_FLASHES = 0.5
"""Share of the scans with two flashes."""
_MOST_EXPRESSION = 0.5
"""Largest strength of a scan's random expression, 1 a plain one."""
_LEAST_ANGLE_DEG = 30.0
"""Between two flashes, which would else be one; no more than the cone they are drawn from allows."""


@dataclass(frozen=True, kw_only=True)
class Population:
    """How alike the people are, and under what they are scanned."""

    individuality: float = 0.7
    """Share of the (logarithmic) albedo that is one's own, within (0, 1]; the rest is common to all, as
    relatives have it. Small shares make people alike, and hard to tell apart."""
    tones: tuple[float, float] = (0.2, 0.45)
    """Range of the skin's tone, 0 lightest ... 1 darkest."""
    light: Literal["flashes", "room"] = "flashes"
    """Flashes: one or two, as often, over ambient light; room: soft light from all around and a weak lamp."""
    light_cone_deg: float = 60.0
    """Lights come from within this angle of the front, uniformly over the solid angle."""
    lamp_colors: float = 0.0
    """Standard deviation of the logarithms of red and blue over green: of the ambient light, in a room
    of each source, and of each lamp; 0 for white ones."""
    scanner: Scanner = Scanner()
    """How each scan is taken."""

    def albedo(
        self, individual: Individual, seed: int, model: AnnotatedSurface, uv: FloatArray
    ) -> FloatArray:
        """Return linear albedo (N, 3) at chart coordinates (N, 2): the person's own, and what all share."""
        mine = individual.albedo(uv, model)
        if self.individuality == 1:
            return mine
        rng, middle = np.random.default_rng([seed, 12]), sum(self.tones) / 2
        shared = paint_face(uv, model, rng, tone=middle, marks=False)
        return np.exp(self.individuality * np.log(mine) + (1 - self.individuality) * np.log(shared))


def population_scan(
    person: int,
    session: int,
    *,
    seed: int = 0,
    population: Population = Population(),
    lamps: tuple[PointLight, ...] | None = None,
) -> tuple[RawScan, SyntheticTruth]:
    """Return the scan "person-<person>-session-<session>" of one person of a population, and its truth.

    Shape, skin with its moles and freckles, brows and lips belong to the person; light, highlight,
    expression, pose, noise and damage to the session. `seed` is that of the population; `lamps` take the
    place of the session's own.
    """
    template = default_model()
    individual = Individual.drawn(np.random.default_rng([seed, person, 11]), population.tones)
    now = np.random.default_rng([seed, person, session, 13])
    room = random_room(now, population.lamp_colors) if population.light == "room" else None
    lights = random_lights(now, population)
    lights = lights if lamps is None else lamps
    material = Material(0.3, float(now.uniform(*_HIGHLIGHT)), 14.0)
    sitter = sit_down(
        individual.shape_seed,
        expression=get_args(Expression)[now.integers(len(get_args(Expression)))],
        model=template,
        expression_strength=float(now.uniform(0, _MOST_EXPRESSION)),
        tone=individual.tone,
        face_albedo=partial(population.albedo, individual, seed, template),
    )
    name = f"person-{person}-session-{session}"
    colors = random_colors(1 + len(lights), now, population.lamp_colors) if population.lamp_colors else None
    if colors is not None and room is not None:
        colors[0] = 1.0  # the room has colours of its own
    ambient = None if room is None else partial(room_light_on, room=room)
    return scan_of(sitter, lights, material, population.scanner, now, name, colors, ambient)


def random_lights(rng: np.random.Generator, population: Population) -> tuple[PointLight, ...]:
    """Return a session's lamps."""
    nearest = np.cos(np.deg2rad(population.light_cone_deg))

    def drawn() -> PointLight:
        z = rng.uniform(nearest, 1)
        turn, radius = rng.uniform(0, 2 * np.pi), np.sqrt(1 - z * z)
        azimuth, elevation = float(np.arctan2(radius * np.cos(turn), z)), radius * np.sin(turn)
        distance, intensity = rng.uniform(*_LIGHT_DISTANCE_MM), rng.uniform(*_FLASH)
        return PointLight(azimuth, float(np.arcsin(elevation)), float(distance), float(intensity))

    first = drawn()
    if population.light == "room":
        return (replace(first, intensity=float(rng.uniform(*_ROOM_LAMP))),)
    if rng.uniform() >= _TWO_FLASHES:
        return (first,)
    apart = np.cos(np.deg2rad(min(_LEAST_ANGLE_DEG, population.light_cone_deg)))
    while True:
        second = drawn()
        if first.direction @ second.direction < apart:
            return first, second
