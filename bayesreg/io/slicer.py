"""Files for 3D Slicer: scenes (.mrml, an XML index of the files beside it), and points as markups (.mrk.json)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
from jaxtyping import Float

from bayesreg.io.atomic import write_json, write_text
from bayesreg.io.spaces import LPS

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


class Item(NamedTuple):
    """One file of a scene.

    Attributes
    ----------
    kind : str
        "volume", "transform", "model" or "markups".
    name : str
    file : str
        The name of the file, in the folder of the scene.
    transform : str
        The name of an earlier item of the kind "transform" that Slicer applies to this item; empty for none.
    colour : tuple
        Red, green, blue and opacity of a model, each in [0, 1].
    """

    kind: str
    name: str
    file: str
    transform: str = ""
    colour: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)


# For each kind: the XML element and the class of its node, and those of its storage.
ELEMENTS = {
    "volume": ("Volume", "vtkMRMLScalarVolumeNode", "VolumeArchetypeStorage", "vtkMRMLVolumeArchetypeStorageNode"),
    "transform": ("Transform", "vtkMRMLTransformNode", "TransformStorage", "vtkMRMLTransformStorageNode"),
    "model": ("Model", "vtkMRMLModelNode", "ModelStorage", "vtkMRMLModelStorageNode"),
    "markups": (
        "MarkupsFiducial", "vtkMRMLMarkupsFiducialNode", "MarkupsFiducialStorage", "vtkMRMLMarkupsFiducialStorageNode",
    ),
}  # fmt: skip
DISPLAYS = {
    "volume": ("VolumeDisplay", "vtkMRMLScalarVolumeDisplayNode", {"colorNodeRef": "vtkMRMLColorTableNodeGrey"}),
    "model": ("ModelDisplay", "vtkMRMLModelDisplayNode", {"visibility": "true"}),
    "markups": ("MarkupsDisplay", "vtkMRMLMarkupsDisplayNode", {"visibility": "true"}),
}


def write_scene(path: str | Path, items: Sequence[Item]) -> None:
    """Write a scene in one step; the files of its items must be in the same folder."""
    scene = ET.Element("MRML", version="Slicer5.0.0", userTags="")
    transforms: dict[str, str] = {}
    for number, item in enumerate(items, start=1):
        element, node, storage, storage_node = ELEMENTS[item.kind]
        references = [f"storage:{storage_node}{number}"]
        ET.SubElement(scene, storage, id=f"{storage_node}{number}", name=f"{item.name} file", fileName=quote(item.file))
        if item.kind in DISPLAYS:
            display, display_node, settings = DISPLAYS[item.kind]
            if item.kind == "model":
                red, green, blue, opacity = item.colour
                settings = settings | {"color": f"{red:g} {green:g} {blue:g}", "opacity": f"{opacity:g}"}
            ET.SubElement(scene, display, id=f"{display_node}{number}", name=f"{item.name} display", attrib=settings)
            references.append(f"display:{display_node}{number}")
        if item.transform:
            references.append(f"transform:{transforms[item.transform]}")
        if item.kind == "transform":
            transforms[item.name] = f"{node}{number}"
        ET.SubElement(scene, element, id=f"{node}{number}", name=item.name, references=";".join(references) + ";")
    ET.indent(scene)
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(scene, encoding="unicode") + "\n")


def write_markups(path: str | Path, names: Sequence[str], points: Float[np.ndarray, "k 3"]) -> None:
    """Write named points, world RAS, mm, as a .mrk.json file."""
    controls = [
        {"id": str(number), "label": name, "position": (point * LPS).tolist(), "positionStatus": "defined"}
        for number, (name, point) in enumerate(zip(names, points, strict=True), start=1)
    ]
    markups = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": controls}
    write_json(path, {"@schema": SCHEMA, "markups": [markups]})
