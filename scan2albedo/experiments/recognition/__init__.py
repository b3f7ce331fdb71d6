"""Figure 10 of the paper on a synthetic population: who is recognised by texture, and who by albedo."""

from scan2albedo.experiments.recognition.experiment import run_recognition_experiment
from scan2albedo.experiments.recognition.options import RecognitionExperimentOptions
from scan2albedo.experiments.recognition.report import MethodResult, RecognitionReport

__all__ = [
    "MethodResult",
    "RecognitionExperimentOptions",
    "RecognitionReport",
    "run_recognition_experiment",
]
