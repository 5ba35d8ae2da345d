"""Nerfacto: hash grid with proposal sampling (Tancik et al. 2023)."""
