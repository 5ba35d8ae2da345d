"""The running edge server: ingest, buffer, update loop, scoring, records."""
