"""Rigid registration of raw scans: from any pose into the model's frame, without landmarks."""

from scan2albedo.registration.inputs import RegistrationOptions
from scan2albedo.registration.register import Registration, register

__all__ = ["Registration", "RegistrationOptions", "register"]
