"""The stage: furniture that opens, a person who opens it, and recordings of that with exact truth, made with MuJoCo.

Needs the extra `stage` (mujoco).
"""
