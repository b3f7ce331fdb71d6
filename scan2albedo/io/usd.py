"""`write_usda`: a mesh with a material of textures as OpenUSD text, which needs no library to write."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.tangents import split_at_seams
from scan2albedo.io.atomic import write_text


def write_usda(
    path: str | Path,
    vertices: FloatArray,
    faces: IntArray,
    uv: FloatArray,
    textures: Mapping[str, tuple[str, str, float]],
    **values: float,
) -> None:
    """Write a mesh (V, 3) mm, (F, 3) with coordinates (F, 3, 2) and a UsdPreviewSurface; raises OutputError.

    `textures` are by the material's input: the file, beside `path` (<UDIM> stands for a tile's number), what
    of it is read ("r"; "rgb", in sRGB; or "normal", in [-1, 1]), and the factor s of the value: of "r" s x,
    or where s is negative |s| (2 x - 1). `values` are inputs without one.

    .. [1] "UsdPreviewSurface Specification", version 2.6, OpenUSD.
    """
    split = split_at_seams(faces, uv)
    inputs = [f"            float inputs:{name} = {value:.6g}" for name, value in values.items()]
    readers = list[str]()
    for name, (file, what, scale) in textures.items():
        signed = what == "normal" or scale < 0
        factor, offset = (2 * abs(scale), -abs(scale)) if signed else (scale, 0.0)
        kind = {"r": "float", "rgb": "color3f", "normal": "normal3f"}[what]
        read, output = ("float", "r") if what == "r" else ("float3", "rgb")
        inputs.append(f"            {kind} inputs:{name}.connect = </face/skin/{name}.outputs:{output}>")
        readers.append(f"""        def Shader "{name}"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./{file}@
            token inputs:sourceColorSpace = "{"sRGB" if what == "rgb" else "raw"}"
            float4 inputs:scale = {_tuples([4 * [factor]])}
            float4 inputs:bias = {_tuples([4 * [offset]])}
            float2 inputs:st.connect = </face/skin/place.outputs:result>
            {read} outputs:{output}
        }}""")
    moved = "displacement" in textures
    text = f"""#usda 1.0
(
    defaultPrim = "face"
    metersPerUnit = 0.001
    upAxis = "Y"
)

def Xform "face"
{{
    def Mesh "surface" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        uniform token subdivisionScheme = "none"
        rel material:binding = </face/skin>
        point3f[] points = [{_tuples(vertices)}]
        int[] faceVertexCounts = {len(faces) * [3]}
        int[] faceVertexIndices = {faces.ravel().tolist()}
        normal3f[] normals = [{_tuples(vertex_normals(vertices, faces))}] (interpolation = "vertex")
        texCoord2f[] primvars:st = [{_tuples(split.uv)}] (interpolation = "faceVarying")
        int[] primvars:st:indices = {split.faces.ravel().tolist()}
    }}

    def Material "skin"
    {{
        token outputs:surface.connect = </face/skin/material.outputs:surface>
{"        token outputs:displacement.connect = </face/skin/material.outputs:displacement>" if moved else ""}
        def Shader "material"
        {{
            uniform token info:id = "UsdPreviewSurface"
{chr(10).join(inputs)}
            token outputs:surface
            token outputs:displacement
        }}
        def Shader "place"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
{chr(10).join(readers)}
    }}
}}
"""
    write_text(path, text)


def _tuples(rows: ArrayLike) -> str:
    return ", ".join(f"({', '.join(f'{value:.7g}' for value in row)})" for row in np.asarray(rows).tolist())
