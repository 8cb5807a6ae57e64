"""Names of the paper's tasks; imports nothing, so that the command line can name them at once."""

from typing import Final

TASKS: Final = ("room_door", "swivel_door", "drawer", "sliding_door")
"""The paper's four tasks. A demonstration may also be of another task, with any other name."""
