"""Geometry checks that need the bodies: joints inside, palms, feet on the floor, nothing in the furniture."""

from __future__ import annotations

import numpy as np
import warp as wp
from layout import FRAMES, JOINTS, PEOPLE, SOLE, WORK
from make_sample import bodies
from meshes import box
from motion import drawer_pull, pose_a, pose_b, time_of
from rig import rest_palm, skin, solve
from room import build_room
from truth import joints_world


@wp.kernel
def _inside(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), depth: wp.array(dtype=wp.float32)):
    i = wp.tid()
    q = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0)
    near = wp.mesh_eval_position(mesh, q.face, q.u, q.v)
    depth[i] = -q.sign * wp.length(points[i] - near)


def main() -> None:
    """Print all results."""
    people = bodies()
    for body, person in zip(people, PEOPLE, strict=True):
        print(person.name, "stature", np.ptp(body.vertices[:, 2]).round(4))
        for side in "LR":
            _, palm = rest_palm(body, side)
            mcp, tip = body.head_of(f"finger3-1.{side}"), body.head_of(f"finger3-3.{side}")
            wrist = body.head_of(f"wrist.{side}")
            along = (mcp - wrist) / np.linalg.norm(mcp - wrist)
            print(
                "  finger flexes towards the palm at rest, cm:",
                side,
                (100 * (tip - mcp) @ (palm - along * (palm @ along))).round(2),
            )
    data = np.load(WORK / "scene.npz")
    things = [
        t
        for t in build_room()
        if len(t.vertices) == 8 and np.array_equal(t.faces, box((0, 0, 0), (1, 1, 1))[1]) and t.name != "laptop_lid"
    ]
    shallow: dict[str, float] = {}
    for k in range(FRAMES):
        for p, body in enumerate(people):
            rot, pos = solve(body, (pose_a, pose_b)[p](body, time_of(k)))
            posed = skin(body.vertices, body.weights, body.heads, rot, pos)
            mesh = wp.Mesh(
                wp.array(posed.astype(np.float32), dtype=wp.vec3),
                wp.array(body.faces.astype(np.int32).ravel(), dtype=wp.int32),
                support_winding_number=True,
            )
            joints = joints_world(body, rot, pos)
            depth = wp.zeros(18, dtype=wp.float32)
            wp.launch(_inside, dim=18, inputs=[mesh.id, wp.array(joints.astype(np.float32), dtype=wp.vec3), depth])
            for name, d in zip(JOINTS, depth.numpy(), strict=True):
                key = f"{PEOPLE[p].name}.{name}"
                shallow[key] = min(shallow.get(key, 9.0), float(d))
            dressed = np.concatenate([data[f"v{i}"][k] for i in np.flatnonzero(data["owner"] == p)])
            shoes = np.concatenate(
                [data[f"v{i}"][k] for i, n in enumerate(data["names"]) if n.startswith(PEOPLE[p].name + ".shoe")]
            )
            hits = []
            for t in things:
                shift = np.array([-drawer_pull(time_of(k)), 0, 0]) if t.drawer else np.zeros(3)
                low, high = t.vertices.min(0) + shift, t.vertices.max(0) + shift
                gap = np.minimum(dressed - low, high - dressed).min(1)
                if gap.max() > 0.003:
                    hits.append(f"{t.name} {1000 * gap.max():.0f} mm x{int((gap > 0).sum())}")
            print(
                k,
                PEOPLE[p].name,
                "lowest",
                dressed[:, 2].min().round(4),
                "shoe",
                shoes[:, 2].min().round(4),
                hits,
            )
    print(
        "depth of each joint inside the bare body, least over the frames, cm:",
        {k: round(100 * v, 1) for k, v in shallow.items()},
    )
    print("sole", SOLE)


if __name__ == "__main__":
    main()
