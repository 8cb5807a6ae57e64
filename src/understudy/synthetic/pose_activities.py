"""What people do, as tables of ranges: lower bodies, hands and activities. Angles in degrees, lengths in metres.

Legs and hands are written for the right side; the other side is its mirror image. Positions are (outward, front, up).
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

Range = tuple[float, float]

# -- lower bodies --------------------------------------------------------------------------------------------------
# fk: thigh and shin by angles (absolute, so that a tilted pelvis does not move the legs) instead of by the foot's place
# flex/abd/rot: thigh forward/outward/turned outward; knee: bend; fpitch: toes down; frel: that relative to the shin
# o/f/lift: ankle from the midpoint of the feet; out: knee further outward than the foot; fyaw: toes outward
# pelvis: tilt forward, roll (left hip up), yaw, sx/sy: shifted left/back from the feet, drop: lower than straight legs
# gait: 1 walks, 2 runs: flex, knee, fpitch come from the cycle; kneel: leg a's knee is on the ground
# seat: height of the hips of who sits; lay: lies down

PELVIS_FIELDS: Final = ("tilt", "roll", "yaw", "sx", "sy", "drop", "gait", "kneel", "amp", "lay", "seat")
LEG_FIELDS: Final = ("fk", "flex", "abd", "rot", "knee", "o", "f", "lift", "fyaw", "fpitch", "frel", "out")

LOWER_DEFAULT: Final = MappingProxyType(
    {
        "tilt": (-6, 12), "roll": (-3, 3), "yaw": (-6, 6), "sx": (0, 0), "sy": (-0.02, 0.04), "drop": (0, 0.02),
        "gait": (0, 0), "kneel": (0, 0), "amp": (1, 1), "lay": (0, 0), "seat": (0, 0),
        "fk": (0, 0), "flex": (0, 0), "abd": (0, 0), "rot": (0, 0), "knee": (0, 0), "o": (0.05, 0.15),
        "f": (-0.06, 0.06),
        "lift": (0, 0), "fyaw": (-8, 28), "fpitch": (0, 0), "frel": (0, 0), "out": (-6, 10),
    }
)  # fmt: skip

_GAIT = {"fk": (1, 1), "abd": (-3, 5), "rot": (-4, 14), "roll": (-4, 4), "yaw": (-8, 8), "fyaw": (-5, 12)}

LOWER: Final[MappingProxyType[str, dict[str, Range]]] = MappingProxyType(
    {
        "stand": {},
        "wide": {"o": (0.12, 0.36), "f": (-0.12, 0.12), "drop": (0, 0.08), "sx": (-0.08, 0.08), "fyaw": (-5, 40)},
        "one_leg": {
            "sx": (-0.10, -0.05), "roll": (-9, -1), "o_b": (0.06, 0.2), "f_b": (-0.05, 0.2), "drop": (0, 0.01),
            "fyaw_b": (5, 45),
        },
        "step": {
            "f_a": (0.12, 0.4), "f_b": (-0.4, -0.1), "sy": (-0.2, 0.15), "drop": (0.0, 0.07), "yaw": (-20, 20),
            "fpitch_b": (0, 35), "roll": (-5, 5),
        },
        "tiptoe": {"fpitch": (20, 45), "f": (-0.1, 0.1), "drop": (0, 0.01)},
        "walk": {**_GAIT, "gait": (1, 1), "amp": (0.45, 1.15), "tilt": (-2, 10)},
        "run": {**_GAIT, "gait": (2, 2), "amp": (0.6, 1.15), "tilt": (2, 18), "yaw": (-12, 12)},
        "lunge": {
            "f_a": (0.3, 0.6), "f_b": (-0.6, -0.3), "sy": (-0.15, 0.15), "drop": (0.05, 0.22), "fpitch_b": (15, 60),
            "tilt": (0, 30), "o": (0.03, 0.16),
        },
        "sit": {
            "seat": (0.40, 0.55), "o": (0.05, 0.3), "f": (0.3, 0.52), "sy": (0, 0), "tilt": (-22, 14), "yaw": (-3, 3),
            "fpitch": (0, 8), "out": (-8, 12),
        },
        "sit_forward": {
            "seat": (0.36, 0.5), "o": (0.04, 0.22), "f": (0.5, 0.74), "sy": (0, 0), "tilt": (-32, 5), "yaw": (-3, 3),
            "fpitch": (-14, 4), "out": (-5, 15),
        },
        "sit_back": {
            "seat": (0.40, 0.54), "o": (0.04, 0.2), "f": (0.06, 0.34), "sy": (0, 0), "tilt": (-8, 25), "yaw": (-3, 3),
            "fpitch": (12, 48), "out": (-4, 14),
        },
        "sit_knee_over": {
            "seat": (0.44, 0.54), "fk_a": (1, 1), "flex_a": (106, 118), "abd_a": (-24, -14), "rot_a": (-12, 4),
            "knee_a": (60, 95), "frel_a": (1, 1), "fpitch_a": (0, 40), "o_b": (0.02, 0.1), "f_b": (0.32, 0.5),
            "sy": (0, 0),
            "tilt": (-25, 6), "yaw": (-3, 3), "fyaw_b": (-5, 10),
        },
        "sit_ankle_over": {
            "seat": (0.42, 0.52), "fk_a": (1, 1), "flex_a": (88, 104), "abd_a": (28, 46), "rot_a": (60, 80),
            "knee_a": (85, 105),
            "frel_a": (1, 1), "fpitch_a": (0, 30), "o_b": (0.06, 0.16), "f_b": (0.34, 0.5), "sy": (0, 0),
            "tilt": (-28, 0),
            "yaw": (-3, 3),
        },
        "sit_high": {
            "seat": (0.56, 0.68), "o": (0.06, 0.3), "f": (0.32, 0.52), "sy": (0, 0), "fpitch": (0, 25),
            "tilt": (-12, 15),
        },
        "sit_floor": {
            "fk": (1, 1), "flex": (84, 100), "abd": (38, 58), "rot": (42, 62), "knee": (112, 138), "frel": (1, 1),
            "fpitch": (10, 50), "tilt": (-25, 12),
        },
        "squat": {
            "o": (0.08, 0.24), "f": (-0.02, 0.2), "drop": (0.2, 0.48), "fpitch": (0, 12), "tilt": (0, 40),
            "out": (0, 25),
            "fyaw": (0, 40), "sy": (0.0, 0.15),
        },
        "squat_deep": {
            "o": (0.08, 0.2), "f": (-0.02, 0.1), "drop": (0.5, 0.66), "fpitch": (15, 50), "tilt": (-5, 35),
            "out": (0, 30),
            "fyaw": (0, 35), "sy": (-0.04, 0.08),
        },
        "kneel_one": {
            "kneel": (1, 1), "fk_a": (1, 1), "flex_a": (-12, 28), "abd_a": (0, 15), "rot_a": (-5, 10),
            "knee_a": (85, 95),
            "frel_a": (1, 1), "fpitch_a": (-10, 60), "o_b": (0.08, 0.24), "f_b": (0.25, 0.5), "sy": (0, 0),
            "tilt": (-4, 30), "fyaw_b": (-5, 25), "out": (0, 10),
        },
        "kneel_both": {
            "kneel": (1, 1), "fk": (1, 1), "flex": (-6, 62), "abd": (0, 22), "rot": (-8, 6), "knee": (90, 90),
            "frel": (1, 1),
            "fpitch": (-5, 65), "tilt": (-5, 30),
        },
        "bend": {"drop": (0, 0.16), "o": (0.06, 0.24), "f": (-0.14, 0.14)},
        "free": {
            "fk": (1, 1), "flex": (-25, 105), "abd": (-12, 50), "rot": (-25, 40), "knee": (0, 135), "frel": (1, 1),
            "fpitch": (-18, 50), "tilt": (-25, 40), "roll": (-15, 15), "yaw": (-15, 15),
        },
        "lie": {
            "fk": (1, 1), "flex": (-10, 70), "abd": (-5, 25), "rot": (-10, 40), "knee": (0, 100), "frel": (1, 1),
            "fpitch": (0, 45), "tilt": (-6, 8), "lay": (1, 1),
        },
    }
)  # fmt: skip

# -- hands ---------------------------------------------------------------------------------------------------------
# (frame of reference, (outward, front, up) ranges of the wrist, the way the palm faces, options)
# frames: shoulder = own shoulder, chest's axes; level = own shoulder, upright axes; pelvis; chest = between the
# shoulders; head; knee = own knee, thigh's axes; ground = below the hips, upright (up is the height above the floor)
# options: elbow = the way the elbow likes to point; curl of the fingers; ball = the ranges are azimuth (0 front, 90
# outward), elevation, distance; palm None = free; wrist = spread of the wrist's bend

FRAMES: Final = ("shoulder", "level", "pelvis", "chest", "head", "knee", "ground")

_SIDE = (0.35, -0.7, -0.6)
_IN, _DOWN, _UP, _BACK, _FRONT = (-1.0, 0.1, 0.0), (0.0, 0.1, -1.0), (-0.2, 0.0, 1.0), (0.0, -1.0, 0.1), (0.0, 1.0, 0.0)
_OPEN, _LOOSE, _FIST = (0, 35), (10, 55), (60, 115)

HANDS: Final[MappingProxyType[str, dict[str, object]]] = MappingProxyType(
    {
        "free": {"fk": 1, "palm": None, "curl": (0, 115), "wrist": 55},
        "hang": {"at": "level", "box": ((0.03, 0.2), (-0.1, 0.13), (-0.565, -0.515)), "palm": _IN, "curl": _LOOSE},
        "swing": {"at": "level", "box": ((0.02, 0.14), (-0.03, 0.06), (-0.56, -0.515)), "palm": _IN, "curl": _LOOSE,
                  "swing": 1},
        "pump": {"at": "level", "box": ((-0.06, 0.1), (0.08, 0.2), (-0.36, -0.2)), "palm": _IN, "curl": _FIST,
                 "swing": 1,
                 "elbow": (0.2, -1, -0.3)},
        "hip": {"at": "pelvis", "box": ((0.2, 0.25), (-0.1, 0.08), (0.06, 0.2)), "palm": (-0.6, 0.2, -0.8),
                "curl": (0, 90),
                "elbow": (1, -0.5, 0)},
        "pocket": {"at": "pelvis", "box": ((0.2, 0.25), (0.0, 0.1), (-0.04, 0.08)), "palm": _IN, "curl": _LOOSE,
                   "elbow": (0.6, -0.8, 0)},
        "behind": {"at": "pelvis", "box": ((-0.04, 0.1), (-0.24, -0.19), (0.0, 0.16)), "palm": _BACK, "curl": _LOOSE,
                   "elbow": (0.8, -0.5, -0.2)},
        "clasp": {"at": "pelvis", "box": ((0.02, 0.1), (0.2, 0.34), (-0.02, 0.24)), "palm": (-0.8, -0.6, 0),
                  "curl": (20, 80)},
        "clasp_high": {"at": "chest", "box": ((0.02, 0.12), (0.2, 0.34), (-0.3, -0.1)), "palm": (-1, -0.2, 0),
                       "curl": (0, 90)},
        "phone_ear": {"at": "head", "box": ((0.1, 0.17), (0.0, 0.1), (-0.08, 0.02)), "palm": _IN, "curl": (30, 80),
                      "elbow": (0.6, 0.3, -1)},
        "phone_look": {"at": "chest", "box": ((-0.06, 0.16), (0.22, 0.4), (-0.32, -0.06)), "palm": (-0.2, -0.8, 0.6),
                       "curl": (30, 80)},
        "talk": {"at": "level", "box": ((-0.14, 0.26), (0.12, 0.42), (-0.42, -0.04)), "palm": None, "curl": (0, 80)},
        "chin": {"at": "head", "box": ((-0.02, 0.08), (0.14, 0.2), (-0.2, -0.1)), "palm": _BACK, "curl": (20, 100)},
        "head": {"at": "head", "box": ((0.1, 0.18), (-0.1, 0.1), (0.06, 0.2)), "palm": _IN, "curl": (0, 70),
                 "elbow": (1, 0.2, 0.3)},
        "nape": {"at": "head", "box": ((0.1, 0.18), (-0.1, -0.02), (-0.02, 0.12)), "palm": (-0.4, 0.8, 0),
                 "curl": (0, 50),
                 "elbow": (1, 0.2, 0.4)},
        "cross_over": {"at": "chest", "box": ((-0.15, -0.06), (0.23, 0.28), (-0.24, -0.14)), "palm": _BACK,
                       "curl": (20, 90),
                       "elbow": (0.7, 0.1, -1)},
        "cross_under": {"at": "chest", "box": ((-0.14, -0.05), (0.16, 0.19), (-0.33, -0.24)), "palm": _BACK,
                        "curl": (0, 90),
                        "elbow": (0.7, 0.1, -1)},
        "knee": {"at": "knee", "box": ((-0.05, 0.05), (0.11, 0.15), (-0.02, 0.14)), "palm": _BACK, "curl": _LOOSE,
                 "elbow": (0.7, -0.3, 0)},
        "lap": {"at": "pelvis", "box": ((0.04, 0.18), (0.14, 0.32), (0.11, 0.2)), "palm": None, "curl": _LOOSE},
        "table": {"at": "pelvis", "box": ((-0.12, 0.4), (0.26, 0.55), (0.14, 0.34)), "palm": _DOWN, "curl": (0, 80)},
        "armrest": {"at": "pelvis", "box": ((0.24, 0.36), (0.1, 0.3), (0.14, 0.28)), "palm": (-0.4, 0, -1),
                    "curl": (10, 90)},
        "seat": {"at": "pelvis", "box": ((0.2, 0.32), (-0.15, 0.12), (-0.1, 0.02)), "palm": _DOWN, "curl": (0, 60)},
        "reach": {"at": "level", "ball": ((-45, 140), (-70, 85), (0.3, 0.545)), "palm": None, "curl": (0, 110),
                  "wrist": 45},
        "far": {"at": "level", "ball": ((-35, 110), (-50, 70), (0.46, 0.548)), "palm": None, "curl": (0, 100),
                "wrist": 40},
        "across": {"at": "level", "ball": ((-75, -35), (-45, 35), (0.3, 0.5)), "palm": None, "curl": (0, 110)},
        "back": {"at": "level", "ball": ((120, 185), (-75, 5), (0.35, 0.54)), "palm": None, "curl": (0, 110)},
        "shelf": {"at": "level", "ball": ((-25, 80), (25, 80), (0.38, 0.548)), "palm": _FRONT, "curl": (0, 100)},
        "push": {"at": "level", "box": ((-0.12, 0.16), (0.3, 0.52), (-0.25, 0.15)), "palm": _FRONT, "curl": _OPEN},
        "floor": {"at": "ground", "box": ((-0.1, 0.45), (0.3, 0.85), (0.04, 0.4)), "palm": None, "curl": (0, 115)},
        "drawer": {"at": "ground", "box": ((-0.2, 0.35), (0.35, 0.8), (0.3, 0.8)), "palm": _DOWN, "curl": _FIST},
        "handle": {"at": "ground", "box": ((-0.3, 0.38), (0.28, 0.62), (0.6, 1.3)), "palm": _DOWN, "curl": _FIST},
        "bar": {"at": "ground", "box": ((-0.3, 0.4), (0.26, 0.6), (0.6, 1.35)), "palm": (-1, 0.2, 0), "curl": _FIST},
        "box": {"at": "level", "box": ((-0.08, 0.12), (0.22, 0.44), (-0.5, -0.05)), "palm": (-0.9, 0, 0.4),
                "curl": _OPEN},
        "tray": {"at": "level", "box": ((-0.12, 0.08), (0.22, 0.4), (-0.42, -0.1)), "palm": _UP, "curl": (10, 90)},
        "load": {"at": "level", "box": ((0.04, 0.2), (-0.08, 0.1), (-0.55, -0.5)), "palm": _IN, "curl": _FIST},
        "shoulder_load": {"at": "chest", "box": ((0.16, 0.3), (0.06, 0.24), (0.06, 0.26)), "palm": (-0.6, -0.2, 0.8),
                          "curl": (0, 80), "elbow": (0.5, 0.7, -0.5)},
        "overhead": {"at": "level", "ball": ((-20, 160), (50, 88), (0.4, 0.548)), "palm": None, "curl": (0, 110)},
        "side": {"at": "level", "ball": ((65, 105), (-25, 30), (0.48, 0.5485)), "palm": _DOWN, "curl": _OPEN},
        "wave": {"at": "level", "box": ((0.05, 0.36), (0.02, 0.3), (0.12, 0.42)), "palm": _FRONT, "curl": _OPEN},
        "throw": {"at": "level", "box": ((0.1, 0.42), (-0.3, -0.02), (0.0, 0.36)), "palm": (0, 0.8, 0.4),
                  "curl": (20, 100)},
        "point": {"at": "level", "ball": ((-30, 110), (-20, 40), (0.44, 0.5485)), "palm": (-0.5, 0, -0.7),
                  "curl": (30, 80)},
    }
)  # fmt: skip

# -- activities ----------------------------------------------------------------------------------------------------
# share; lower bodies and their weights; (hand a, hand b, weight) - 'name+' on hand b: it mirrors hand a's place;
# trunk: fold (pelvis forward), bend, lean, twist of the chest relative to the pelvis, nod, tip, turn of the head
# relative to the chest, look: how often the head turns to hand a

TRUNK_FIELDS: Final = ("fold", "bend", "lean", "twist", "nod", "tip", "turn", "look")
TRUNK_DEFAULT: Final = MappingProxyType(
    {"fold": (0, 0), "bend": (-8, 22), "lean": (-9, 9), "twist": (-16, 16), "nod": (-22, 36), "tip": (-16, 16),
     "turn": (-70, 70), "look": 0.15}
)  # fmt: skip

ACTIVITY_TABLE: Final[MappingProxyType[str, dict[str, object]]] = MappingProxyType(
    {
        "random": {
            "share": 0.24, "lower": {"free": 5, "stand": 1.5, "wide": 1, "step": 1, "sit": 0.7, "squat": 0.6,
                                     "walk": 0.5},
            "hands": (("free", "free", 7), ("free", "reach", 2), ("free", "hang", 0.5)),
            "bend": (-20, 55), "lean": (-25, 25), "twist": (-38, 38), "nod": (-42, 48), "tip": (-28, 28),
            "fold": (-5, 25),
        },
        "standing": {
            "share": 0.12, "lower": {"stand": 6, "one_leg": 2.5, "wide": 1, "step": 0.7},
            "hands": (
                ("hang", "hang", 4), ("hip", "hip+", 1), ("hip", "hang", 1), ("pocket", "pocket+", 0.8), ("pocket",
                "hang", 0.8),
                ("behind", "behind+", 1), ("clasp", "clasp+", 1.5), ("clasp_high", "clasp_high+", 0.7),
                ("phone_ear", "hang", 0.8),
                ("phone_ear", "pocket", 0.4), ("phone_look", "hang", 0.8), ("phone_look", "phone_look", 0.7),
                ("talk", "talk", 1.8),
                ("talk", "hang", 1), ("talk", "hip", 0.4), ("chin", "hang", 0.5), ("chin", "cross_under", 0.6),
                ("head", "hang", 0.4), ("point", "hang", 0.7), ("push", "push+", 0.3), ("table", "table", 0.8),
            ),
            "bend": (-8, 15),
        },
        "arms_crossed": {
            "share": 0.03, "lower": {"stand": 5, "one_leg": 2, "wide": 1, "sit": 1.2},
            "hands": (("cross_over", "cross_under", 1),), "bend": (-6, 16), "twist": (-10, 10),
        },
        "walking": {
            "share": 0.09, "lower": {"walk": 1},
            "hands": (("swing", "swing", 6), ("swing", "phone_ear", 0.3), ("phone_look", "swing", 0.5), ("pocket",
                      "swing", 0.4),
                      ("pocket", "pocket+", 0.4), ("talk", "swing", 0.4)),
            "bend": (-4, 16), "lean": (-5, 5), "twist": (-10, 10), "turn": (-55, 55),
        },
        "running": {
            "share": 0.03, "lower": {"run": 6, "lunge": 4},
            "hands": (("pump", "pump", 6), ("free", "free", 1.5), ("reach", "free", 1)),
            "bend": (-2, 24), "turn": (-35, 35),
        },
        "sitting": {
            "share": 0.12,
            "lower": {"sit": 6, "sit_forward": 1.5, "sit_back": 1.2, "sit_knee_over": 1.1, "sit_ankle_over": 0.8,
                      "sit_high": 0.9, "sit_floor": 0.6},
            "hands": (
                ("knee", "knee+", 2), ("knee", "knee", 1), ("lap", "lap", 2), ("table", "table", 3.5), ("armrest",
                "armrest+", 1),
                ("armrest", "lap", 0.7), ("seat", "seat+", 0.4), ("chin", "table", 0.6), ("chin", "lap", 0.4),
                ("phone_look", "lap", 0.7),
                ("phone_look", "phone_look", 0.5), ("talk", "talk", 1), ("reach", "table", 1), ("reach", "lap", 0.6),
                ("phone_ear", "lap", 0.3), ("clasp_high", "clasp_high+", 0.4), ("nape", "nape+", 0.2),
            ),
            "bend": (-8, 40), "lean": (-14, 14), "twist": (-22, 22), "fold": (-4, 22), "look": 0.3,
        },
        "crouching": {
            "share": 0.06, "lower": {"squat": 3, "squat_deep": 2.4, "kneel_one": 2.6, "kneel_both": 2},
            "hands": (("floor", "knee", 2), ("floor", "floor", 2), ("knee", "knee+", 1), ("reach", "knee", 2),
                      ("reach", "reach", 1.5),
                      ("drawer", "hang", 1), ("talk", "knee", 0.7), ("free", "free", 0.6), ("hang", "hang", 0.5)),
            "bend": (0, 45), "lean": (-12, 12), "twist": (-20, 20), "look": 0.5,
        },
        "bending": {
            "share": 0.06, "lower": {"bend": 6, "step": 2, "squat": 1.2},
            "hands": (("floor", "floor", 2.5), ("floor", "hang", 2), ("floor", "knee", 1.5), ("drawer", "hang", 1.2),
                      ("drawer", "drawer+", 0.6),
                      ("hang", "hang", 0.8), ("knee", "knee+", 0.6), ("reach", "reach", 0.8), ("floor", "reach", 0.6)),
            "fold": (16, 60), "bend": (14, 60), "lean": (-12, 12), "twist": (-25, 25), "nod": (-45, 20), "look": 0.5,
        },
        "reaching": {
            "share": 0.09, "lower": {"stand": 3, "step": 3, "wide": 1, "tiptoe": 0.8, "sit": 1, "squat": 0.6,
                                     "one_leg": 0.6},
            "hands": (("reach", "hang", 3), ("far", "hang", 1.5), ("shelf", "hang", 1), ("shelf", "shelf+", 0.8),
                      ("across", "hang", 1),
                      ("back", "hang", 0.8), ("reach", "reach", 2), ("push", "push+", 1), ("reach", "free", 0.8),
                      ("far", "hip", 0.4)),
            "fold": (0, 15), "bend": (-6, 34), "lean": (-18, 18), "twist": (-30, 30), "look": 0.6,
        },
        "opening": {
            "share": 0.05, "lower": {"stand": 3, "step": 4, "wide": 0.6, "walk": 0.8, "bend": 0.8},
            "hands": (("handle", "hang", 4), ("bar", "hang", 4), ("handle", "handle+", 0.6), ("bar", "reach", 0.8),
                      ("bar", "push", 0.6),
                      ("handle", "load", 0.5)),
            "fold": (-2, 14), "bend": (-6, 26), "twist": (-28, 28), "look": 0.5,
        },
        "carrying": {
            "share": 0.05, "lower": {"stand": 3, "walk": 4, "step": 1.5, "bend": 0.5},
            "hands": (("box", "box+", 3), ("tray", "tray+", 1.6), ("load", "hang", 1), ("load", "swing", 0.8),
                      ("load", "load+", 0.7),
                      ("shoulder_load", "hang", 0.7), ("shoulder_load", "shoulder_load+", 0.2), ("tray", "hang", 0.5)),
            "bend": (-14, 18), "lean": (-10, 10), "twist": (-12, 12), "turn": (-50, 50),
        },
        "raised": {
            "share": 0.04, "lower": {"stand": 4, "wide": 2, "step": 2, "walk": 0.5, "one_leg": 0.6},
            "hands": (("overhead", "overhead", 2), ("overhead", "overhead+", 1.2), ("wave", "hang", 1.2), ("wave",
                      "wave+", 0.5), ("side", "side+", 1),
                      ("throw", "reach", 1), ("nape", "nape+", 0.7), ("head", "head", 0.4), ("overhead", "hang", 0.7)),
            "bend": (-18, 14), "lean": (-15, 15), "twist": (-28, 28),
        },
        "lying": {
            "share": 0.02, "lower": {"lie": 1},
            "hands": (("hang", "hang", 2), ("lap", "hang", 1), ("lap", "lap", 1), ("nape", "nape+", 0.6), ("free",
                      "free", 2), ("side", "reach", 1)),
            "bend": (-5, 18),
        },
    }
)  # fmt: skip

ACTIVITIES: Final[MappingProxyType[str, float]] = MappingProxyType(
    {name: float(row["share"]) for name, row in ACTIVITY_TABLE.items()}  # type: ignore[arg-type]
)
"""Activity name -> default share of the mix."""
