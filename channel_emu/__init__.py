"""Emulates a bad network between cameras and the edge: chain -> traffic -> link -> faults.

``model.link.Link`` decides what happens to each frame, and reads no clock. ``live`` runs links on the wall
clock, ``virtual`` in virtual time; the same offers and seed give the same decisions in both. ``estimate``
fits a channel to a recording. These three packages import ``model``, and none imports another.
"""
