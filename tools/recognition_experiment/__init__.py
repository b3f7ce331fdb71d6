"""Figure 10 of the paper on a synthetic population: who is recognised by texture, and who by albedo."""

from recognition_experiment.experiment import run_recognition_experiment
from recognition_experiment.options import RecognitionExperimentOptions
from recognition_experiment.report import MethodResult, RecognitionReport

__all__ = [
    "MethodResult",
    "RecognitionExperimentOptions",
    "RecognitionReport",
    "run_recognition_experiment",
]
