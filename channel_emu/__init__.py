"""Emulates a bad network between cameras and the edge: chain -> traffic -> link -> (faults).

``link.Link`` decides what happens to each frame and knows no clock. ``proxy`` drives links by the wall
clock, ``simulate`` by virtual time; with the same offers and seed they decide alike.
"""
