from __future__ import annotations

import re
from pathlib import Path

import pytest

from gpuvision.formats.materials_file import read_materials
from gpuvision.schema import DescriptionError
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Ggx, Lambert, OrenNayar, Phong, Ward

GOOD = """
[[material]]
name = "solder mask"
albedo = 0.3
gloss = {model = "phong", albedo = 0.1, exponent = 40}

[[material]]
albedo = 0.5
roughness = 0.4

[[material]]
albedo = 0.5
slope_sigma = 0.3

[[material]]
name = "pad"
albedo = 0.1
mirror = 0.6

[[material]]
albedo = 0.0
[material.gloss]
model = "ggx"
alpha = 0.1
f0 = 0.9

[[material]]
albedo = 0.2
roughness = 0.0
gloss = {model = "ward", albedo = 0.3, alpha_x = 0.1, alpha_y = 0.4}

[[material]]
albedo = 1.0
slope_sigma = 0.0
mirror = 0.0
"""


def read(tmp_path, text):
    path = tmp_path / "materials.toml"
    path.write_text(text)
    return read_materials(path)


def test_materials_come_in_the_order_of_the_file(tmp_path):
    assert read(tmp_path, GOOD) == (
        Material(diffuse=Lambert(albedo=0.3), gloss=Phong(albedo=0.1, exponent=40.0), name="solder mask"),
        Material(diffuse=OrenNayar(albedo=0.5, roughness=0.4)),
        Material(diffuse=OrenNayar.from_slope_sigma(albedo=0.5, sigma=0.3)),
        Material(diffuse=Lambert(albedo=0.1), mirror=0.6, name="pad"),
        Material(diffuse=Lambert(albedo=0.0), gloss=Ggx(alpha=0.1, f0=0.9)),
        Material(diffuse=Lambert(albedo=0.2), gloss=Ward(albedo=0.3, alpha_x=0.1, alpha_y=0.4)),
        Material(diffuse=Lambert(albedo=1.0)),
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"no table \[\[material\]\]"),
        ("material = 3", r"tables \[\[material\]\]"),
        ("[[material]]\nalbedo = 1.5", r"material\[0\].albedo is 1.5"),
        ("[[material]]\nalbedo = 0.5\nmirror = 0.7", r"material\[0\]: Material reflects 1.20"),
        ("[[material]]\nalbedo = 0.5\n[[material]]\nname = 'x'", r"material\[1\].albedo' is missing"),
        ("[[material]]\nalbedo = 0.5\nroughness = 0.1\nslope_sigma = 0.1", "both roughness and slope_sigma"),
        ("[[material]]\nalbedo = 0.5\ngloss = {model = 'fong'}", "did you mean"),
        ("[[material]]\nalbedo = 0.5\ngloss = {model = 'ggx', alpha = 0, f0 = 1}", "Ggx.alpha is 0"),
        ("[[material]]\nalbedo = 0.5\ngloss = {model = 'ggx', alpha = 0.1, f0 = 1, beta = 2}", r"gloss\.beta"),
        ("[[material]]\nalbedo = 0.5\nroughness = 1.001", r"material\[0\]\.roughness is 1\.001"),
        ("[[material]]\nalbedo = 0.5\nslope_sigma = 1.571", r"material\[0\]\.slope_sigma is 1\.571 rad"),
        ("[[material]]\nalbedo = 0.5\nmiror = 0.1", r"unknown key 'material\[0\].miror'"),
    ],
)
def test_what_a_file_cannot_say(tmp_path, text, words):
    with pytest.raises(DescriptionError, match=words):
        read(tmp_path, text)


def test_a_lobe_out_of_range_names_file_and_table(tmp_path: Path) -> None:
    path = tmp_path / "paint.toml"
    path.write_text('[[material]]\nalbedo = 0.5\ngloss = {model = "phong", albedo = 1.1, exponent = 40}\n')
    with pytest.raises(
        DescriptionError, match=rf"^{re.escape(str(path))}: material\[0\]\.gloss: Phong\.albedo is 1\.1"
    ):
        read_materials(path)
