"""`write_usda`: a mesh with a material of textures as OpenUSD text, which needs no library to write."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import ArrayLike, FloatArray, IntArray
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.tangents import split_at_seams
from scan2albedo.io.atomic import write_text


def write_usda(
    path: str | Path,
    vertices: FloatArray,
    faces: IntArray,
    uv: FloatArray,
    textures: Mapping[str, str],
    displacement_mm: float = 1.0,
    **values: float,
) -> None:
    """Write a mesh (V, 3) mm, (F, 3) with coordinates (F, 3, 2) and a UsdPreviewSurface; raises OutputError.

    `textures` are files beside `path` (<UDIM> stands for a tile's number) by the material's input: a
    diffuseColor in sRGB, a normal in [-1, 1], a displacement from -`displacement_mm` to it, others in [0, 1].
    `values` are inputs without one.

    .. [1] "UsdPreviewSurface Specification", version 2.6, OpenUSD.
    """
    split = split_at_seams(faces, uv)
    inputs = [f"            float inputs:{name} = {value:.6g}" for name, value in values.items()]
    readers = list[str]()
    for name, file in textures.items():
        kind = {"diffuseColor": "color3f", "normal": "normal3f"}.get(name, "float")
        read, output = ("float", "r") if kind == "float" else ("float3", "rgb")
        most = {"normal": 1.0, "displacement": displacement_mm}.get(name)
        factor, offset = (1.0, 0.0) if most is None else (2 * most, -most)
        inputs.append(f"            {kind} inputs:{name}.connect = </face/skin/{name}.outputs:{output}>")
        readers.append(f"""        def Shader "{name}"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./{file}@
            token inputs:sourceColorSpace = "{"sRGB" if name == "diffuseColor" else "raw"}"
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
