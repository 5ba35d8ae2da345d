"""Specular highlights of the light on every surface, which move with the viewer.

Every surface gets a clear coat: a microfacet surface with the GGX distribution of slopes, Smith's masking for
correlated heights and Fresnel's equations for unpolarized light (Walter et al., "Microfacet models for
refraction through rough surfaces", EGSR 2007, equations 20, 22 and 33; Heitz, "Understanding the
masking-shadowing function", JCGT 2014, equation 99).
"""

from __future__ import annotations

import dataclasses
from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.scene import Scene
from camera_node.synthetic.shapes import normalize
from freshfield.geometry import Array
from freshfield.settings import within


class Specular(EffectParameters, frozen=True):
    """Rendered ahead; free while streaming. List it ``in_truth: true`` if the field is to show the
    highlights."""

    refractive_index: Annotated[
        float, within(1.0, 50.0, "of the coat; 1 reflects nothing, 1.5 is varnish or plastic")
    ] = 1.5
    roughness: Annotated[
        float, within(0.02, 1.0, "width of the GGX distribution, from .02 (polished) to 1 (matte)")
    ] = 0.2

    kind: ClassVar[str] = "world"

    def extend(self, scene: Scene) -> Scene:
        return scene.with_world(dataclasses.replace(scene.world, specular=self))

    def reflectance(self, to_light: Array, normals: Array, rays: Array) -> Array:
        """pi times the BRDF (1/sr) times the cosine at the surface, so that a white Lambert surface has the
        cosine alone; see ``lighting.SpecularReflection``."""
        half = normalize(to_light - rays)
        light = np.maximum((normals * to_light).sum(axis=0), 0.0)
        view = np.maximum(-(normals * rays).sum(axis=0), 0.0)
        a2 = self.roughness**2
        across = np.clip((normals * half).sum(axis=0), 0.0, 1.0)
        slopes = a2 / (across * across * (a2 - 1.0) + 1.0) ** 2  # pi times the distribution
        masks = light * np.sqrt(view * view * (1.0 - a2) + a2) + view * np.sqrt(light * light * (1.0 - a2) + a2)
        visibility = 0.5 / np.maximum(masks, 1e-9)  # masking over 4 cos cos
        return slopes * visibility * self.fresnel(-(half * rays).sum(axis=0)) * light

    def fresnel(self, cosine: Array) -> Array:
        """Share of unpolarized light that a smooth facet reflects, for a cosine to its normal."""
        c = np.clip(cosine, 0.0, 1.0)
        g = np.sqrt(self.refractive_index**2 - 1.0 + c * c)
        across = (g - c) / np.maximum(g + c, 1e-12)
        along = (c * (g + c) - 1.0) / (c * (g - c) + 1.0)
        return 0.5 * across**2 * (1.0 + along**2)
