"""Numbers of the launcher; what differs from run to run is an option of the command, or a key of the scenario."""

# --- while a scenario runs (launcher) ---
TICK_S = 0.25  # time between two looks at the processes
LINE_EVERY_S = 5.0  # time between two status lines for people
SAMPLE_EVERY_S = 2.0  # time between two samples of memory and processor time of every process, in ``processes.jsonl``

# --- starting, answers and the report (ports, healthy, deployment, launcher) ---
ANSWER_S, PAGE_ANSWER_S = 0.5, 1.0  # a process, and the page, answer within it once they are ready
HEALTH_ANSWER_S = 2.0  # the same of a container that is asked whether it is healthy
STARTED_POLL_S = 0.1  # between two looks, from a program, at whether a deployment is ready
# Longest wait for a process to be ready: a first start compiles the field's kernels, for a minute, or more on a busy
# machine.
READY_WITHIN_S = 600.0
REPORT_WITHIN_S = 300.0  # longest wait for the report at the end

# --- the end of a process (launcher, child_process) ---
# Time for a process to end after SIGTERM before it is killed: the edge server waits up to 20 s for its last update.
GRACE_S = 30.0
STOPPED_POLL_S = 0.05  # between two looks at whether a process that was told to end has ended
LAST_LINES = 12  # that are shown of the log of a process that died

# --- health of containers (healthy) ---
FRESH_S = 10.0  # age of a node's status file up to which its container is healthy; it is written every second
