"""Worlds whose truth is known: Person x Expression x Light x Camera x Scanner. Where each one is made:

People: painted ones (`sitters`), ones hard to tell apart (`population`), on the face model (`model_faces`),
    of the light stage (`light_stage`), of ../shared/data/heads (`lit_heads`); what is no face (`objects`);
    a person with glasses (`glasses_on_head`), a moving one (`takes`).
Expressions: the package's and an open jaw (`sitters`); the light stage's own (`light_stage`).
Light: rigs for the path tracer (`lamps`: sky, softboxes, window, flashes, ...); environment maps, everyday
    ones among them (`environments`); soft light of a room from all around, with one bounce (`rooms`).
Cameras: of a photographic scanner (`pictures`), on an arc with flashes (`flash_captures`, `traced_captures`,
    `two_balls`).
Scanners: two clean pods (`raw_like`), raw passive stereo (`stereo`), one with photographs (`traced_scans`).
Together: `synthetic_scans` (registration, fit), `door` (is it a face?), `traced_scans`, `traced_charts` and
    `mitsuba_scenes` (albedo), `traced_sessions` (recognition), `unknown_faces` (one photograph).
Not made here, read by `bench.judging`: ../shared/data/real_skin, path-traced elsewhere (d_office is an office
    ceiling, d_flash_room, d_dome, ...: `SKIN` in tools/figures.py), and ../shared/data/yale, photographs.
To add a light: a `Rig` in `lamps.rigs`, or a function of directions in `lamps.ENVIRONMENTS`; the scans of
    `traced_scans.recipes` name the rig that they stand in.
The path tracer is Mitsuba (`path_tracer`); `python tools/worlds OUT` makes its scans and images.
"""
