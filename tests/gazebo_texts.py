"""Texts of Gazebo worlds, for tests that read them."""

from __future__ import annotations

from pathlib import Path

CYLINDER = "<cylinder><radius>0.1</radius><length>1</length></cylinder>"


def body(shape: str, pose: str = "") -> str:
    return f"<collision name='c'>{pose}<geometry>{shape}</geometry></collision>"


def model(inside: str, pose: str = "", name: str = "m", link: str = "") -> str:
    return f"<model name='{name}'>{pose}<link name='l'>{link}{inside}</link></model>"


def pose(*numbers: float, attributes: str = "") -> str:
    return f"<pose {attributes}>{' '.join(map(str, numbers))}</pose>"


def sdf_of(*models: str) -> bytes:
    return f"<sdf version='1.6'><world name='w'>{''.join(models)}</world></sdf>".encode()


def moving(plugin: str, name: str = "m") -> str:
    return model(body(CYLINDER), name=name).replace("</model>", f"{plugin}</model>")


def write_model(folder: Path, name: str, content: str, file: str = "model.sdf") -> None:
    (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / name / file).write_text(f"<sdf version='1.6'>{content}</sdf>", encoding="utf-8")


def include(uri: str, inside: str = "", attributes: str = "") -> str:
    return f"<include {attributes}><uri>{uri}</uri>{inside}</include>"
