"""Taxel boards without hardware: field model, firmware, faults, and the ports they appear on."""
