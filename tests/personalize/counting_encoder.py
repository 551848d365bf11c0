"""A made-up speech encoder that counts how often it is asked."""

from dataclasses import dataclass

import numpy as np

from tests.model.talker import W


@dataclass
class CountingEncoder:
    """50 rows a second of loudness and noise, as wide as the talker's checkpoint wants."""

    name: str = "test"
    width: int = W
    rate: float = 50.0
    calls: int = 0

    def encode(self, audio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.calls += 1
        rows = max(1, len(audio) // 320)
        features = np.random.default_rng(len(audio)).standard_normal((rows, self.width)).astype(np.float32)
        return features * np.abs(audio).mean(), np.arange(rows) / self.rate
