"""Which way palms face: `HandNormalEstimator`."""

from understudy.hands.estimator import HandNormalEstimator

__all__ = ["HandNormalEstimator"]
