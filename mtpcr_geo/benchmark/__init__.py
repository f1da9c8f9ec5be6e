"""How good is it: metrics, simulator, protocol."""
