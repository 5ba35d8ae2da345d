"""Numbers of synthetic worlds. Another value makes another key of rendered frames (``frame_cache``)."""

from __future__ import annotations

# --- captures (source) ---
# A sequence with more different frames counts as not repeating: rendered on demand and not kept.
WORLD_MAX_FRAMES = 3000

# --- light (render, lighting) ---
# Shadow rays end this share of their length before the surface, so that it does not shadow itself.
SHADOW_BIAS = 2e-3
# Contact shadows end at this distance (meters) from the body's middle, and take away at most this share.
CONTACT_REACH_M, CONTACT_MOST_DARKENING = 0.8, 0.75

# --- a carried camera (walk) ---
# 32 units of .6 s: at 10 captures a second a lap has 192, a multiple of 8, of which each 8th can be held out.
WALK_LAP_S = 19.2
WALK_RADIUS = 0.2  # of the room's width: between furniture and walls of all rooms that were looked at
WALK_BENDS, WALK_BEND = 3.0, 0.15  # of the radius: number a lap, and share of it
EYE_HEIGHT_M = 1.45
AIM_HEIGHT_M = 0.85  # of the point across the room that is looked at: what stands there, not the wall above
# Step frequency 1.7 Hz (32 a lap); amplitudes of head and hand while walking.
WALK_STEPS, BOB_M, SWAY_M = 32, 0.015, 0.02
# (cycles a lap, amplitude in degrees) of the rotation about the camera's x, y and z: looking about, then tremor.
WALK_TURNS = (((3, 5.0), (23, 0.5)), ((5, 9.0), (29, 0.6)), ((4, 3.0), (26, 0.5)))
