"""The command ``freshfield-up``: starts and supervises every process of a scenario on one machine."""
