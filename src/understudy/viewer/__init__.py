"""The viewer: a local web page with the point cloud, the skeletons and the image of each frame.

    from understudy.viewer import view
    view("RESULTS")                     # a folder that `understudy estimate` wrote

    results.py  what is shown: people.json and the recording it was made from, frame by frame
    cloud.py    coloured points from a registered frame
    floor.py    where up and the floor are
    scene.py    the 3D scene
    panel.py    the side panel
    app.py      view(): the server, playing, closing

Needs the extra 'viewer' (viser). Importing this package does not.
"""

from understudy.viewer.app import Viewer, view

__all__ = ["Viewer", "view"]
