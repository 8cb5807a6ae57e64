"""Procedural Blender materials; the base colour comes from the mesh attribute `tint`."""

from __future__ import annotations

from typing import Any

import bpy

ROUGH = {
    "skin": 0.5,
    "cloth": 0.92,
    "leather": 0.5,
    "hair": 0.68,
    "wall": 0.95,
    "floor": 0.38,
    "wood": 0.5,
    "paint": 0.55,
    "metal": 0.35,
    "leaf": 0.5,
    "picture": 0.6,
}


class Graph:
    """Short-hand for wiring shader nodes."""

    def __init__(self, name: str) -> None:
        self.mat = bpy.data.materials.new(name)
        self.mat.use_nodes = True
        self.tree = self.mat.node_tree
        self.bsdf = self.tree.nodes["Principled BSDF"]

    def node(self, kind: str, **settings: Any) -> Any:
        """A new node with its properties set."""
        n = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(n, key, value)
        return n

    def link(self, source: Any, target: Any) -> None:
        """Connect two sockets."""
        self.tree.links.new(source, target)

    def attribute(self, name: str) -> Any:
        """A mesh attribute's vector."""
        return self.node("ShaderNodeAttribute", attribute_name=name).outputs["Vector"]

    def math(self, op: str, a: Any, b: Any = 0.0) -> Any:
        """A scalar operation."""
        n = self.node("ShaderNodeMath", operation=op)
        for k, x in enumerate((a, b)):
            if isinstance(x, (int, float)):
                n.inputs[k].default_value = x
            else:
                self.link(x, n.inputs[k])
        return n.outputs[0]

    def noise(self, vector: Any, scale: float, detail: float = 2.0) -> Any:
        """Noise in 0..1."""
        n = self.node("ShaderNodeTexNoise")
        n.inputs["Scale"].default_value, n.inputs["Detail"].default_value = scale, detail
        self.link(vector, n.inputs["Vector"])
        return n.outputs["Fac"]

    def scaled(self, vector: Any, factors: tuple[float, float, float]) -> Any:
        """Component-wise product."""
        n = self.node("ShaderNodeVectorMath", operation="MULTIPLY")
        self.link(vector, n.inputs[0])
        n.inputs[1].default_value = factors
        return n.outputs[0]

    def mix(self, fac: Any, a: Any, b: Any) -> Any:
        """Colour mix."""
        n = self.node("ShaderNodeMix", data_type="RGBA")
        for sock, x in ((n.inputs[0], fac), (n.inputs[6], a), (n.inputs[7], b)):
            if isinstance(x, (int, float)):
                sock.default_value = x
            elif isinstance(x, tuple):
                sock.default_value = (*x, 1.0)
            else:
                self.link(x, sock)
        return n.outputs[2]

    def bump(self, height: Any, distance: float, strength: float = 1.0) -> None:
        """Bump the surface."""
        n = self.node("ShaderNodeBump")
        n.inputs["Distance"].default_value, n.inputs["Strength"].default_value = distance, strength
        self.link(height, n.inputs["Height"])
        self.link(n.outputs[0], self.bsdf.inputs["Normal"])

    def vary(self, color: Any, fac: Any, amount: float) -> Any:
        """Darken and lighten a colour by noise."""
        low = self.node("ShaderNodeVectorMath", operation="SCALE")
        self.link(color, low.inputs[0])
        self.link(self.math("ADD", self.math("MULTIPLY", fac, 2 * amount), 1.0 - amount), low.inputs["Scale"])
        return low.outputs[0]


def stripes(g: Graph, coord: Any, period: float, share: float) -> Any:
    """1 on the stripes, 0 between."""
    return g.math("LESS_THAN", g.math("FRACT", g.math("ADD", g.math("DIVIDE", coord, period), 50.0)), share)


def shirt_color(g: Graph, pattern: str, tint: Any, second: tuple[float, float, float]) -> Any:
    """Plain, or crossed bands of a second colour."""
    if pattern != "check":
        return tint
    sep = g.node("ShaderNodeSeparateXYZ")
    g.link(g.attribute("pattern"), sep.inputs[0])
    s, t = sep.outputs[0], sep.outputs[1]
    bands = g.math("MULTIPLY", g.math("ADD", stripes(g, s, 0.062, 0.42), stripes(g, t, 0.062, 0.42)), 0.5)
    base = g.mix(bands, tint, second)
    thin = g.math(
        "MAXIMUM",
        stripes(g, g.math("ADD", s, 0.02), 0.062, 0.07),
        stripes(g, g.math("ADD", t, 0.02), 0.062, 0.07),
    )
    return g.mix(g.math("MULTIPLY", thin, 0.7), base, (0.5, 0.08, 0.06))


def material(name: str) -> bpy.types.Material:
    """The material of that name, made once."""
    if name in bpy.data.materials:
        return bpy.data.materials[name]
    g = Graph(name)
    kind = name.split("_")[0]
    tint, rest = g.attribute("tint"), g.attribute("rest")
    g.bsdf.inputs["Roughness"].default_value = ROUGH.get(kind, 0.9)
    color = tint
    if kind == "window":
        g.bsdf.inputs["Emission Strength"].default_value = 1.7
        sky = g.noise(g.scaled(rest, (1.2, 1.0, 2.2)), 1.4, 3.0)
        g.link(g.mix(sky, (0.55, 0.72, 0.95), (0.95, 0.97, 1.0)), g.bsdf.inputs["Emission Color"])
    elif kind == "floor":
        b = g.node("ShaderNodeTexBrick")
        b.inputs["Color1"].default_value, b.inputs["Color2"].default_value = (
            (0.34, 0.20, 0.11, 1),
            (0.25, 0.14, 0.075, 1),
        )
        b.inputs["Mortar"].default_value = (0.07, 0.04, 0.025, 1)
        for key, value in (
            ("Scale", 1.0),
            ("Mortar Size", 0.004),
            ("Brick Width", 1.1),
            ("Row Height", 0.14),
        ):
            b.inputs[key].default_value = value
        swap = g.node("ShaderNodeMapping")
        swap.inputs["Rotation"].default_value = (0, 0, 1.5708)
        g.link(rest, swap.inputs["Vector"])
        g.link(swap.outputs[0], b.inputs["Vector"])
        color = g.vary(b.outputs["Color"], g.noise(g.scaled(rest, (22.0, 1.6, 1.0)), 2.0, 6.0), 0.35)
    elif kind == "wood":
        color = g.vary(tint, g.noise(g.scaled(rest, (1.5, 18.0, 18.0)), 2.0, 6.0), 0.35)
    elif kind == "picture":
        n = g.noise(g.scaled(rest, (1.0, 1.0, 3.0)), 5.0, 3.0)
        color = g.mix(g.math("GREATER_THAN", n, 0.5), (0.62, 0.50, 0.28), (0.08, 0.20, 0.26))
    elif kind == "wall":
        color = g.vary(tint, g.noise(rest, 3.0, 4.0), 0.05)
        g.bump(g.noise(rest, 160.0), 0.002, 0.3)
    elif kind == "skin":
        g.bsdf.inputs["Subsurface Weight"].default_value = 0.0
        color = g.vary(tint, g.noise(rest, 60.0, 3.0), 0.07)
    elif kind in ("cloth", "shirt"):
        if kind == "shirt":
            color = shirt_color(g, name.split("_")[1], tint, (0.045, 0.12, 0.34))
        color = g.vary(color, g.noise(rest, 9.0, 5.0), 0.13)
        g.bump(g.noise(g.scaled(rest, (1.0, 1.0, 0.55)), 14.0, 3.0), 0.016, 0.65)
    elif kind == "hair":
        g.bsdf.inputs["Specular IOR Level"].default_value = 0.2
        color = g.vary(tint, g.noise(g.scaled(rest, (1.0, 1.0, 0.12)), 220.0, 2.0), 0.6)
        g.bump(g.noise(g.scaled(rest, (1.0, 1.0, 0.12)), 180.0, 2.0), 0.004, 0.8)
    if kind == "metal":
        g.bsdf.inputs["Metallic"].default_value = 0.8
    g.link(color, g.bsdf.inputs["Base Color"])
    return g.mat
