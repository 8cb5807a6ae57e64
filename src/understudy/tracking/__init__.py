"""People over time: who is who, and where each joint was, given what was seen before and after (docs/tracking.md)."""

from understudy.tracking.identities import MEMORY, MEMORY_S, IdentityTracker
from understudy.tracking.kalman import Model
from understudy.tracking.live import LiveTracker, TrackedPeople
from understudy.tracking.smoother import REACH_S, PersonTrack, frame_times, smooth, track

__all__ = [
    "MEMORY",
    "MEMORY_S",
    "REACH_S",
    "IdentityTracker",
    "LiveTracker",
    "Model",
    "PersonTrack",
    "TrackedPeople",
    "frame_times",
    "smooth",
    "track",
]
