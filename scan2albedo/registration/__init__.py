"""Rigid registration of raw scans: from any pose into the model's frame, without landmarks."""

from scan2albedo.registration.register import Registration, register
from scan2albedo.registration.scan_preparation import RegistrationOptions

__all__ = ["Registration", "RegistrationOptions", "register"]
