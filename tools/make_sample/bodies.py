"""Rest bodies from anny: mesh, skinning weights, skeleton, COCO key points and labelled face parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from layout import Array, Person
from numpy.typing import NDArray

PARTS = (
    "head",
    "eye_front.L",
    "eye_front.R",
    "eye_back.L",
    "eye_back.R",
    "eye_cavity.L",
    "eye_cavity.R",
    "mouth_cavity",
    "tongue",
)


@dataclass
class Body:
    """One person in the rest pose (x to the person's left, y to the back, z up; soles at z = 0)."""

    vertices: Array
    faces: NDArray[np.int64]
    bones: list[str]
    parents: list[int]
    heads: Array  # rest position of every bone's head
    weights: Array  # (vertices, bones)
    coco: dict[str, Array]
    parts: dict[str, NDArray[np.bool_]]  # per face

    def head_of(self, label: str) -> Array:
        """Rest position of a bone's head."""
        return self.heads[self.bones.index(label)]

    def weight_of(self, *prefixes: str) -> Array:
        """Summed weight per vertex of the bones whose names start so."""
        return self.weights[:, [b.startswith(prefixes) for b in self.bones]].sum(1)


def build_bodies(people: tuple[Person, ...]) -> list[Body]:
    """The rest bodies, with the phenotype's height solved for each person's stature."""
    import anny
    import torch
    from anny.face_segmentation import get_face_segmentation_mask
    from anny.keypoints import KeypointsRegressor

    model = anny.Anny(rig="anny", topology="anny", phenotypes="all", facial_actions="all")
    regressor = KeypointsRegressor.coco(model)
    parts = {p: get_face_segmentation_mask(model, [p]).numpy() for p in PARTS}
    faces = model.faces.numpy().astype(np.int64)
    weights = np.zeros((len(model.template_vertices), model.bone_count))
    np.add.at(
        weights,
        (np.arange(len(weights))[:, None], model.vertex_bone_indices.numpy()),
        model.vertex_bone_weights.numpy(),
    )

    def rest(person: Person, height: float) -> tuple[Array, Array, Array]:
        shape = {k: torch.tensor([v], dtype=torch.float64) for k, v in person.phenotype.items()}
        shape["height"] = torch.tensor([height], dtype=torch.float64)
        face = {k: torch.tensor([v], dtype=torch.float64) for k, v in person.face.items()}
        out = model(phenotype_kwargs=shape, facial_actions=face)
        vertices = out["rest_vertices"]
        points = regressor({"vertices": vertices})[0].numpy()
        return vertices[0].numpy(), out["rest_bone_heads"][0].numpy(), points

    bodies = []
    for person in people:
        low, high = 0.1, 0.9
        for _ in range(22):
            mid = 0.5 * (low + high)
            if np.ptp(rest(person, mid)[0][:, 2]) < person.stature:
                low = mid
            else:
                high = mid
        vertices, heads, points = rest(person, 0.5 * (low + high))
        up = np.array([0.0, 0.0, -vertices[:, 2].min()])
        bodies.append(
            Body(
                vertices + up,
                faces,
                list(model.bone_labels),
                [int(p) for p in model.bone_parents],
                heads + up,
                weights,
                dict(zip(regressor.labels, points + up, strict=True)),
                parts,
            )
        )
    return bodies
