"""Bodies of tapered tubes, ellipsoids and rounded boxes with the proportions of ANSUR II; need no body model.

Every part is a *loft*: rings of superellipses along a straight axis with rounded ends. Parts overlap at the joints.
Surface that lies inside trunk, neck or head of the average body gets no points; the rounded ends of the limbs inside
their neighbours keep theirs (they are hidden, and come out at the outside of a bent elbow or knee).
"""

from __future__ import annotations

import torch

from understudy.synthetic.ansur import draw_sex, draw_stature
from understudy.synthetic.bodies import BodyBank
from understudy.synthetic.capsule_loft import loft_faces
from understudy.synthetic.capsule_people import arm_axes, people
from understudy.synthetic.capsule_skinning import skinning_weights
from understudy.synthetic.segments import SEGMENT
from understudy.synthetic.surface import SIDES, alignment, drape, even_samples, regions, vertex_normals


def build(n: int, seed: int, points: int) -> BodyBank:
    """n bodies with `points` surface points each. Deterministic for a given seed."""
    generator = torch.Generator().manual_seed(seed)
    female = draw_sex(n, generator)
    stature = draw_stature(female, generator)
    origins, parts, joints, tips = people(female, stature, generator)
    vertices = [p.vertices() for p in parts]
    count = vertices[0].shape[1]
    one = torch.from_numpy(loft_faces())
    faces = torch.cat([one + k * count for k in range(len(parts))])
    mean = [v.mean(0) for v in vertices]
    weights = torch.cat([skinning_weights(p, m, origins.mean(0)) for p, m in zip(parts, mean, strict=True)])

    keep = []
    for part, spots in zip(parts, mean, strict=True):
        centre = spots[one].mean(1)
        others = [q for q in parts if q is not part and q.segment in ("chest", "neck", "head")]
        inside = torch.stack([q.contains(centre, 0.012) for q in others]).any(0)
        if part.segment == "chest":  # the trunk's edge inside the ball of the shoulder
            balls = origins.mean(0)[[SEGMENT["right_upper_arm"], SEGMENT["left_upper_arm"]]]
            inside |= torch.cdist(centre, balls).amin(1) < 0.047
        keep.append(~inside)
    face, bary = even_samples(torch.cat(mean), faces, torch.cat(keep).float(), points, generator)
    corner = faces[face]
    every = torch.cat(vertices, 1)
    normal = vertex_normals(every, faces)
    spots = (every[:, corner] * bary[..., None]).sum(2)
    weights = (weights[corner] * bary[..., None]).sum(1)
    region, along = regions(spots.mean(0), weights, origins.mean(0), joints.mean(0))
    normals = torch.nn.functional.normalize((normal[:, corner] * bary[..., None]).sum(2), dim=2)
    tilt = torch.stack([arm_axes(s)[:, 1] for _, s in SIDES])  # the palms look down when the arms are level
    return BodyBank(
        points=spots,
        normals=normals,
        weights=weights,
        origins=origins,
        align=alignment(origins, -tilt.expand(n, 2, 3), tips, torch.tensor([0.0, -1.0, 0.0]).expand(n, 2, 3)),
        joints=joints,
        region=region,
        along=along,
        drape=drape(spots, normals, region),
        stature=stature,
        female=female,
    )
