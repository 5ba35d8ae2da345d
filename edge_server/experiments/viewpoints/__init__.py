"""Captures planned in scenarios: their candidates, pictures and reconstructions."""
