"""One number fitted after training: a temperature, so that the model is as sure as it is right on activities it has not seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from corpus import Encoder
from data import Program
from evaluate import Scene, cases_of, label_log_probs
from model import Household
from narration import DEFAULT_BINDING

TEMPERATURES = np.arange(0.8, 2.51, 0.05)


def fit(model: Household, encoder: Encoder, programs: list[Program], graphs: list[Path]) -> float:
    """The temperature with the lowest mean negative log-likelihood of the next object over the labels of the given scenes."""
    total = np.zeros(len(TEMPERATURES))
    for path in graphs:
        scene = Scene(path)
        cases = list(cases_of(programs, scene))
        cue, bos = encoder.ids(DEFAULT_BINDING), encoder.tokenizer.bos_id()
        prompts = [[bos] + [t for text in told for t in encoder.ids(text)] + cue for _, told, *_ in cases]
        scores = label_log_probs(model, encoder, prompts, [encoder.ids(label) for label in scene.labels])
        truth = np.array([scene.index[case[3]] for case in cases])
        for k, temperature in enumerate(TEMPERATURES):
            scaled = scores / temperature
            total[k] += (np.logaddexp.reduce(scaled, axis=1) - scaled[np.arange(len(cases)), truth]).sum()
    return float(TEMPERATURES[total.argmin()])


def apply(model: Household, temperature: float) -> None:
    """Divides every logit by the temperature, by way of the last normalisation's weights: the file needs no new field."""
    model.norm.weight.data /= temperature
