"""Where to look next (thesis 4.5): candidate viewpoints, selectors, and the reward of people's preferences.

    candidates = half_hemisphere(target, radius_m, lens, 100)
    plan = plan_capture(candidates, make_selector("coverage"), Budget(views=8), capture)

A selector is a name and one method, ``values`` (``selector.Selector``); a line in ``selector.SELECTORS``
makes it known to the commands. ``preferences`` asks people, ``reward`` learns from what they say, ``policy``
plans by that. Nothing here knows of a robot or a scene: what reaches a candidate, and what takes the picture,
are arguments.
"""
