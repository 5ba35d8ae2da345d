"""Where to look next (thesis 4.5): candidate viewpoints, selectors, and the reward of people's preferences.

    candidates = half_hemisphere(target, radius_m, lens, 100)
    plan = plan_capture(candidates, make_selector("coverage"), Budget(views=8), capture)

A selector is a name and one method, ``values`` (``registry.Selector``); a line in ``registry.SELECTORS``
makes it known to the commands. ``preference_session`` asks people, ``preference_model`` learns a reward from
their answers, ``policy`` plans by that reward. Nothing here knows of a robot or a scene: which candidates can
be reached, and what takes the pictures, are arguments.
"""
