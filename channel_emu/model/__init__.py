"""The channel itself, without a clock: chain, traffic, service times, link, faults, closed forms."""
