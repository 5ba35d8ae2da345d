"""Numbers of the splat stream."""

from __future__ import annotations

VERSION = 1
"""Of the messages. A reader refuses others."""

CHUNK = 128
"""Static Gaussians sent together."""
COLOR_LOW, COLOR_STEP = -0.5, 2.0 / 255
"""Colors of Gaussians may leave [0, 1] by half (``fields.splat.settings``)."""
MOST_ANCHORS = 255
"""A byte names an anchor."""
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
NEW_SET_EVERY_S = 1.0
"""Between two static sets with other Gaussians, as while a field grows: each is sent whole."""
NEW_SET_S = 2.0
"""A new static set is cut so that the visitor's link takes it in this time, the largest Gaussians first."""

FIRST_WINDOW, LEAST_WINDOW, MOST_WINDOW = 8_192, 4_096, 2_000_000
"""Bytes under way to a visitor: at first, at least, at most."""
QUEUE_S = 0.08
"""Delay beyond the shortest round trip at which a link counts as full."""
JITTER_OF = 2
"""Round trips whose least is compared with that."""
BACK_OFF = 0.7
"""Factor on the window then, once a round trip."""
FORGET_RTT_S = 30.0
"""The shortest round trip is that of this time."""
PROBE_EVERY_S, PROBE_EVERY = 4.0, 5
"""So rarely, in seconds and in messages, a link is let run empty for a probe: a small message whose round trip has no
queue of ours in it."""
PROBE_BYTES = 1_024
"""Of a probe, at most: knots of a publication."""
FIRST_PROBES, PROBES_KEPT = 4, 16
"""Until so many, each second message is a probe; the mean of so many tells how far round trips scatter. One very late
probe of four does not decide; with five, a link that scatters by a second is held back for two seconds more."""
SCATTERING_UNDER_WAY = 2
"""Messages under way on a link whose round trips scatter. The emulator's TCP takes as long for a small piece as for 16
kB: with many small messages it carries a twelfth of what it could."""
FULL_OF_SCATTER = 4.0
"""Such a link counts as full from a lateness of so many times its scatter. With 4 it carries 56 % of what it takes
(mean delay 0.4 s, loss 0.2)."""
SCATTERING_MOST = 32_768
"""Bytes of a message on such a link, two pieces of the emulator's TCP: the next message waits for all of it."""
SCATTERING_SET_S = 8.0
"""As NEW_SET_S, on such a link: it is slow, and the set that is shown stays meanwhile."""
SCATTERING_GAIN = 0.5
"""Of what was acknowledged, most that the window of such a link changes by."""
MOVING_SHARE = 0.6
"""Of the link, for moving sets: what does not fit is cut, the smallest Gaussians first."""
LEAST_MOVING = 64
"""Gaussians of a moving set, however slow the link: sets become fewer from there on."""
