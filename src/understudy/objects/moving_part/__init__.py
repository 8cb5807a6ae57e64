"""The moving part of furniture without markers: door leaf, cabinet door, drawer, sliding door, from depth."""

from understudy.objects.moving_part.finder import find_moving_part
from understudy.objects.moving_part.part import HandHint, MovingPart, MovingPartConfig

__all__ = ["HandHint", "MovingPart", "MovingPartConfig", "find_moving_part"]
