# SPDX-License-Identifier: GPL-3.0-or-later
"""Attributes of splats read at the points that are drawn, as nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from .node_builder import Input, Tree, Value


@dataclass(frozen=True)
class Sampled:
    """A splat attribute, by name and Blender's type, at the drawn points.

    Sampling from new points instead of deleting and instancing the splats' own: nothing copies their up to 75
    harmonics. splats: the geometry that has the attributes; splat: field of the index among them.
    """

    SOCKETS: ClassVar = {"Splats": "Geometry", "Splat": "Int"}
    """What a node group takes to sample the same (`given`, `within`)."""

    tree: Tree
    splats: Value
    splat: Value

    @classmethod
    def within(cls, tree: Tree, given: Input) -> Sampled:
        """Inside a node group that has `SOCKETS`."""
        return cls(tree, given("Splats"), given("Splat"))

    @property
    def given(self) -> dict[str, Any]:
        """The values of `SOCKETS`."""
        return {"Splats": self.splats, "Splat": self.splat}

    def __call__(self, name: Value, kind: str) -> Value:
        return self.field(self.tree.attribute(name, kind), kind)

    def field(self, value: Value, kind: str) -> Value:
        """A field over the splats."""
        inputs = {"Geometry": self.splats, "Value": value, "Index": self.splat}
        return self.tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")

    def has(self, name: str, kind: str) -> Value:
        """Whether the splats have the attribute, as a single boolean."""
        return self.tree.has(self.splats, name, kind)
