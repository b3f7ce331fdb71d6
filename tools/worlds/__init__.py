"""Worlds whose truth is known: Person x Expression x Light x Camera x Scanner. Where each one is made:

People: painted ones of the package (`sitters`), ones hard to tell apart (`population`), on the face model
    (`model_faces`), of the light stage (`light_stage`), of ../shared/data/heads (`lit_heads`); and no faces
    (`objects`).
Expressions: the package's and an open jaw (`sitters`); the light stage's own (`light_stage`).
Light: rigs for the path tracer (`lamps`: sky, softboxes, window, flashes, ...); environment maps, everyday
    ones among them (`environments`); soft light of a room, an office say, with one bounce (`rooms`).
Cameras: of a photographic scanner (`pictures`), on an arc with flashes (`flash_captures`, `traced_captures`).
Scanners: two clean pods (`raw_like`), raw passive stereo (`stereo`), one with photographs (`traced_scans`).
Together: `synthetic_scans` (registration, fit), `door` (is it a face?), `traced_scans`, `traced_charts` and
    `mitsuba_scenes` (albedo), `traced_sessions` (recognition), `unknown_faces` (one photograph).
The path tracer is Mitsuba (`path_tracer`); `python tools/worlds OUT` makes its scans and images.
"""
