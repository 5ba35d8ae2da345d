"""Emulates a bad network between cameras and the edge: chain -> traffic -> link -> faults.

``model.link.Link`` decides what happens to each frame and knows no clock. ``live`` runs links on the wall
clock, ``virtual`` in virtual time; with the same offers and seed they decide alike. ``estimate`` fits a
channel to a recording. All three import ``model`` and none imports another.
"""
