"""Numbers of captures that are planned, compared and shown to people."""

from __future__ import annotations

# --- a capture and its plan (stage, viewpoints_command) ---
PLAN_CANDIDATES = 100  # of a plan in a synthetic scene
PLAN_FIT_STEPS = 400  # optimizer steps of each fit
TRAVEL_WEIGHT = 0.2  # of path length against value, each over its range
HELD_OUT_VIEWPOINTS = 20  # of a synthetic scene, between the candidates in their sector
PLANNED_VIEWS = 8  # of each reconstruction that is compared with others, if the budget is only in meters
STAGE_EMBEDDING_DIM = 8  # numbers per image that policies over viewpoints are taught with
# How near to a camera the field of a capture may have density, as a share of the cameras' distance from the target.
NEAR_OF_RADIUS = 0.3

# --- what people who are asked are shown (reconstructions, asking, viewpoints_command) ---
QUESTIONS, RECONSTRUCTIONS = 60, 24  # pairs that are shown; reconstructions that they are taken from
PATH_FRAMES, PATH_COLUMNS = 24, 6  # images of a reconstruction along the path; columns of them in their common JPEG
PATH_WIDEST_PX = 320  # largest width of such an image
PATH_FARTHEST_DEG = 60.0  # most that the path turns to each side of its middle
PATH_JPEG_QUALITY = 92  # from 0 to 100: its artifacts must not affect the comparison
PLAN_SHOWN_S = 10.0  # time that the page has to fetch the plan, before the server ends
