"""Action models: how a robot opens something, learnt from adapted demonstrations, for any pose of the object."""

from understudy.actions.model import ActionModel, SegmentModel, learn
from understudy.actions.motions import RobotMotion, RobotPose
from understudy.actions.reproduction import Reproduction
from understudy.actions.skill import Skill, load_skill, save_skill

__all__ = [
    "ActionModel",
    "Reproduction",
    "RobotMotion",
    "RobotPose",
    "SegmentModel",
    "Skill",
    "learn",
    "load_skill",
    "save_skill",
]
