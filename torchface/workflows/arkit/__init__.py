"""Any head model or rig with ARKit's shapes on its own topology, and its animations as ARKit weights."""
