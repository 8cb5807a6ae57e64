"""Frames from your own driver, as arrays: no files needed. Here the arrays come from the bundled recording."""

import numpy as np

import understudy
from understudy import Camera, Frame, RGBDCamera

source = understudy.recordings.open("sample")
rgb = source[0].color  # (h, w, 3) uint8, RGB
millimetres = (source[0].depth * 1000).astype(np.uint16)  # (hd, wd), as depth cameras give it
color_K, depth_K = source.camera.color.K, source.camera.depth.K
T_color_depth = source.camera.T_color_depth  # depth camera's frame -> colour camera's frame, metres

camera = RGBDCamera(  # make it once: tables for the registration are kept with it
    color=Camera(
        rgb.shape[1], rgb.shape[0], color_K
    ),  # distortion_model="brown_conrady", distortion=(...) if it has any
    depth=Camera(millimetres.shape[1], millimetres.shape[0], depth_K),
    T_color_depth=T_color_depth,
)
estimator = understudy.Estimator()  # keep it: it holds the networks

frame = Frame(color=rgb, depth=millimetres.astype(np.float32) / 1000, camera=camera)
for person in estimator.estimate(frame):
    right_wrist = person.keypoints[4]
    print(person.id, right_wrist.round(3), f"probability of being within 10 cm: {person.confidence[4]:.2f}")
