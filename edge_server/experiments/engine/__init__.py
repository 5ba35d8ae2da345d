"""Repeated work: the same function of many inputs, each result kept and never computed twice.

Studies, the frontier, the benches and the trainings all run on this. A command lists its inputs and calls::

    engine = Engine(out / "results.jsonl", jobs=args.jobs, ray=args.ray)
    rows = engine.run(measure, points, "frontier")

``measure`` is a function at the top level of a module: it takes one input and returns a JSON value (numbers, texts,
lists, mappings; a dataclass is returned as a mapping). An input is a dataclass, a mapping or any other JSON value.
Results come back in the order of the inputs, the same bit for bit whether they were computed here (``jobs=1``), in
processes or on a Ray cluster, and are appended to the file as they come, so that after Ctrl-C the same command
computes only what is missing. Without a file nothing is kept.

*When a result is known.* Its key is a hash of the input, of the contents of the files it reads
(``files=lambda point: [folder / point.data]``; folders with all that is in them), of the syntax trees of this project's
modules, but of a few folders that compute nothing, and of ``measure``'s (docstrings, comments and formatting do not
count), of the versions of the packages that compute, and of the kind of processor, since kernels compiled for another
kind round differently. So a result of older code or changed data is never reused, and nothing has to be deleted by
hand.

*What is not part of the key.* Arguments bound by ``functools.partial(measure, folders=folders)``: bind only where
things lie, never what changes a result, and name the files themselves by ``files``.

*What inputs share* (images, a warm field) is made once a process by a function with ``functools.cache`` at the top
level of a module. ``group=lambda point: point.scene`` puts inputs that share into one task, ``batch`` of them at
most, which one process computes in the order given. Inputs without a group are tasks of one.

*Threads.* Processes share the cores evenly; results must not depend on how many each has. Where they do (torch),
``Engine(..., threads=1)`` fixes the number, in this process too.
"""

from edge_server.experiments.engine.content_key import processor
from edge_server.experiments.engine.engine import Engine, EngineError

__all__ = ["Engine", "EngineError", "processor"]
