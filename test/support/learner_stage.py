"""A learner with everything that comes out of it."""

import numpy as np

from semiparam_ros.online.learner import Learner
from support.node_helpers import BODY, SETTINGS, DelayedBackground


class Stage:
    """A learner with everything that came out of it."""

    def __init__(self, settings=SETTINGS, background=None, body=BODY, checkpoint=lambda: None):
        self.answers, self.errors, self.horizons, self.news, self.reverted = [], [], [], [], []
        self.changes = []
        self.background = background or DelayedBackground()
        self.failures = []
        self.learner = Learner(settings, body, self.background, self, checkpoint)

    def answered(self, answer):
        self.answers.append(answer)

    def horizon_completed(self, errors):
        self.errors.append(errors)

    def shadow_horizon_completed(self, variant, errors):
        self.horizons.append((variant, errors))

    def announce(self, sentence):
        self.news.append(sentence)

    def model_switched(self, success, sentence):
        self.news.append(sentence)

    def settings_reverted(self, settings):
        self.reverted.append(settings)

    def change_reported(self, record):
        self.changes.append(record)

    def failed(self, place, error):
        self.failures.append((place, error))

    def offer(self, samples):
        for sample in samples:
            self.learner.offer(sample)

    def offer_and_build(self, samples):
        """Offer them, then let the background do all that waits."""
        self.offer(samples)
        self.background.run()

    @property
    def means(self):
        return np.array([answer.prediction.mean for answer in self.answers])
