"""Numbers of the splat stream."""

from __future__ import annotations

CHUNK = 128
"""Static Gaussians sent together."""
KNOTS_SENT = 6
"""Newest knots of the motion: the display needs four, those before serve a visitor whose messages come late."""

TICK_S = 0.03
"""Between two looks at what the field has published, while somebody watches."""
IDLE_S = 0.5
"""The same while nobody does; whoever comes ends it."""
STATUS_EVERY_S = 0.5
"""Cameras, ages and the line of text."""
MOVING_EVERY_S = 0.1
"""Between two moving sets. One .18 s old with new knots is 27 dB like the newest where it moves."""
STATIC_EVERY_S = 0.5
"""Between two looks at which static chunks have changed."""
CHANGED_SHARE = 0.02
"""Share of a chunk's weight that has changed noticeably, from which it is sent again."""
BUSY = 8.0
"""Static records are made again after so many times what they took: an eighth of a core at most."""
SAMPLED, SAME_WITHIN = 512, 0.02
"""Gaussians by whose places two static sets are told apart, and scene units that half of them move at most, if the
field goes on with the same ones."""
NEW_SET_EVERY_S = 1.0
"""Between two static sets with other Gaussians, as while a field grows: each is sent whole."""
NEW_SET_S = 3.0
"""A new static set is cut so that the visitor's link takes it in this time, the largest Gaussians first."""

FIRST_WINDOW, LEAST_WINDOW, MOST_WINDOW = 8_192, 4_096, 2_000_000
"""Bytes under way to a visitor: at first, at least, at most."""
QUEUE_S = 0.08
"""Delay beyond the shortest round trip at which a link counts as full."""
KEPT_OF_ROUND_TRIPS = 0.95
"""Weight of all earlier round trips at each newer one, where what bytes under way add to them is fitted."""
LEAST_SPREAD = 0.05
"""Share of the bytes under way by which they must vary for that."""
OUTAGE = 4.0
"""Round trips count as no longer than so many times the mean."""
BACK_OFF = 0.85
"""Most that a window shrinks by at an acknowledgement."""
FORGET_RTT_S = 30.0
"""The shortest round trip is that of this time."""
UNDER_WAY, LEAST_MESSAGE, MOST_MESSAGE = 4, 2_400, 16_384
"""Messages that share the window; bytes of one: at least a chunk and knots, at most a piece of the emulator's TCP."""
SCATTERING_UNDER_WAY = 2
"""Messages under way on a link whose round trips scatter. The emulator's TCP takes as long for a small piece as for 16
kB: with many small messages it carries a twelfth of what it could."""
MOVING_SHARE = 0.6
"""Of the link, for moving sets: what does not fit is cut, the smallest Gaussians first."""
LEAST_MOVING = 64
"""Gaussians of a moving set, however slow the link: sets become fewer from there on."""
