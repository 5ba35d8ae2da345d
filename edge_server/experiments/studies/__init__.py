"""Studies: the thesis's figures and some additional ones, as commands with verdicts.

A study (``study.Study``) defines points, each a ``trial.Trial``. ``engine`` runs the trials without stored
results; ``common.statistics`` compares seeds. A new study needs one class file and a line in
``registry.STUDIES``.
"""
