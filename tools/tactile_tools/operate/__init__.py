"""Operate rigs: status, tare, health, keys, service units."""
