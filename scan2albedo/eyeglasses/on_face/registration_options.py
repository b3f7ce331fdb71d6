"""Settings of the registration on a face."""

from __future__ import annotations

from dataclasses import dataclass

from scan2albedo.eyeglasses.weighting.options import WeightOptions


@dataclass(frozen=True)
class FaceRegistrationOptions:
    """Settings of `register_on_face`.

    Lengths in mm are those of a frame of usual size, whose bones' median is 30 mm; they scale with the frame.
    """

    bend: bool = True
    """Whether the frame may bend; otherwise it is moved as it is."""
    label_noise_px: float = 2.0
    """How far labels of key points are usually off; labels many times that hardly pull."""
    outline_noise_px: float = 1.0
    """How far a mask's outline is usually off."""
    outline_correlation_px: float = 20.0
    """Length over which a mask's errors are alike: pixels of the outline nearer than that share one vote."""
    outline_stride: int = 1
    """One in so many pixels of the outline is looked at, spread evenly; each counts for so many."""
    outline_reach_px: float = 40.0
    """Pixels of the outline farther from the observed one than this are left out, and nearer ones where the
    frame's place is known better."""
    head_margin_px: float = 4.0
    """Pixels of the outline this near to where the head hides the frame are left out."""
    contact: bool = True
    """Whether the frame is made to rest on the nose where the views do not see depth and there is a head."""
    contact_mm: float = 1.0
    """Usual distance between nose and frame."""
    stretch: float = 0.001
    """By how much of its length a bone is usually stretched."""
    rim_turn_rad: float = 0.005
    """How much neighbouring key points of a rim are usually turned against each other."""
    bridge_turn_rad: float = 0.02
    """The same across the bridge."""
    temple_turn_rad: float = 0.03
    """The same for hinges and temples."""
    observed_mm: float = 1.2
    """Standard deviation up to which a point counts as observed."""
    steps: int = 40
    """Most steps of a stage's descent."""
    outlines: int = 10
    """Most times that the outline is traced anew."""
    weights: WeightOptions = WeightOptions()
    """How weights are solved, where the glasses bring none."""

    def __post_init__(self) -> None:
        for name in ("outline_stride", "steps", "outlines"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 or more")
