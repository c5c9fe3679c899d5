"""Non-rigid ICP: energy, schedule and steps that bend a template onto a scan."""
