from __future__ import annotations

import pytest

from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Ggx, Lambert, OrenNayar, Phong, Ward


def test_a_material_has_the_albedo_of_its_diffuse_part():
    assert Material(diffuse=Lambert(albedo=0.4), gloss=Phong(albedo=0.5, exponent=30.0)).albedo == 0.4
    assert Material(diffuse=OrenNayar(albedo=0.3, roughness=0.5), mirror=0.7).albedo == 0.3


@pytest.mark.parametrize(
    "gloss",
    [Phong(albedo=0.5, exponent=1e5), Phong(albedo=0.5, exponent=2.0), Ward(albedo=0.5, alpha_x=1e-3, alpha_y=2e-3)],
)
def test_more_light_than_arrives_is_refused(gloss):
    Material(diffuse=Lambert(albedo=0.5), gloss=gloss)
    with pytest.raises(ValueError, match="reflects"):
        Material(diffuse=Lambert(albedo=0.55), gloss=gloss)


@pytest.mark.parametrize("alpha", [1e-3, 0.05, 0.3])
def test_a_facet_lobe_of_full_fresnel_leaves_nothing_to_the_diffuse_part(alpha):
    with pytest.raises(ValueError, match="reflects"):
        Material(diffuse=Lambert(albedo=0.2), gloss=Ggx(alpha=alpha))
    Material(diffuse=Lambert(albedo=0.2), gloss=Ggx(alpha=alpha, f0=0.75))


def test_a_lobe_is_no_diffuse_part():
    with pytest.raises(TypeError, match="expected Lambert"):
        Material(diffuse=Phong(albedo=0.5, exponent=3.0))
    with pytest.raises(TypeError, match="expected a Brdf"):
        Material(diffuse=Lambert(albedo=0.5), gloss=0.3)
    with pytest.raises(ValueError, match="0 to 1"):
        Material(diffuse=Lambert(albedo=0.5), mirror=-0.1)
