"""What a run was measured on, where the system tells it and where it does not."""

from __future__ import annotations

import os

from edge_server.machine import machine


def test_gpus_are_named_and_a_machine_without_proc_is_unknown(tmp_path):
    found = machine(tmp_path)
    assert found["memory_gb"] is None and found["gpus"] == []
    assert found["cores"] == len(os.sched_getaffinity(0))
    gpu = tmp_path / "driver/nvidia/gpus/0000:01:00.0/information"
    gpu.parent.mkdir(parents=True)
    gpu.write_text("Model: \t\t NVIDIA H100 80GB HBM3\nIRQ:   \t\t 42\n")
    (other := gpu.parent.parent / "0000:02:00.0").mkdir()
    (other / "information").write_text("IRQ:   \t\t 43\n")
    assert machine(tmp_path)["gpus"] == ["NVIDIA H100 80GB HBM3"]
