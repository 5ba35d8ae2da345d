"""Numbers of the splat stream."""

from __future__ import annotations

# --- what is sent (published, visitor) ---
CHUNK = 128  # static Gaussians sent together
# Newest knots of the motion: the display needs four, those before serve a visitor whose messages come late.
KNOTS_SENT = 6

# --- how often (stream, published, visitor) ---
TICK_S = 0.03  # between two looks at what the field has published, while somebody watches
IDLE_S = 0.5  # between two looks while nobody does; whoever comes ends it
STATUS_EVERY_S = 0.5  # between two messages with cameras, ages and the line of text
# Between two moving sets: where it moves, one that is .18 s old shows with new knots the same as the newest, to 27 dB.
MOVING_EVERY_S = 0.1
STATIC_EVERY_S = 0.5  # between two looks at which static chunks have changed
CHANGED_SHARE = 0.02  # a chunk is sent again once this share of its weight has changed noticeably
BUSY = 8.0  # static records are made again after so many times what they took: an eighth of a core at most
# Whether the field goes on with the same static Gaussians: number of those that are compared, and scene units that half
# of them move at most.
SAMPLED, SAME_WITHIN = 512, 0.02
NEW_SET_EVERY_S = 1.0  # between two static sets with other Gaussians, as while a field grows: each is sent whole
# A new static set is cut so that the visitor's link takes it in this time, the largest Gaussians first.
NEW_SET_S = 3.0

# --- what a visitor's link takes (visitor) ---
FIRST_WINDOW, LEAST_WINDOW, MOST_WINDOW = 8_192, 4_096, 2_000_000  # bytes under way to a visitor: at first, bounds
QUEUE_S = 0.08  # a link counts as full at this delay beyond the shortest round trip
# What bytes under way add to round trips is fitted: weight of all earlier round trips at each newer one, and share of
# the bytes under way by which they must vary for the fit.
KEPT_OF_ROUND_TRIPS, LEAST_SPREAD = 0.95, 0.05
OUTAGE = 4.0  # a round trip counts as no longer than so many times the mean
BACK_OFF = 0.85  # least factor by which a window shrinks at an acknowledgement
FORGET_RTT_S = 30.0  # the shortest round trip is that of the last so many seconds
UNDER_WAY = 4  # messages that share the window
LEAST_MESSAGE, MOST_MESSAGE = 2_400, 16_384  # bytes of one: a chunk and knots; a piece of the emulator's TCP
# Messages under way on a link whose round trips scatter. The emulator's TCP takes as long for a small piece as for 16
# kB: with many small messages it carries a twelfth of what it could.
SCATTERING_UNDER_WAY = 2
MOVING_SHARE = 0.6  # of the link, for moving sets: what does not fit is cut, the smallest Gaussians first
LEAST_MOVING = 64  # Gaussians of a moving set, however slow the link: below, sets become fewer instead
