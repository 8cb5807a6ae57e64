"""The three lines: the people of one frame of the bundled recording, in metres."""

import understudy

recording = understudy.recordings.open("sample")  # or the path of your own
people = understudy.Estimator().estimate(recording[0])

for person in people:
    neck = person.keypoints[1]  # COCO-18 order; metres, colour camera's frame
    print(f"person {person.id}: neck at {neck.round(2)} m, {person.source.count('observed')} joints observed")
