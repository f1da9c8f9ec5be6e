"""Whether a registration may be believed: evidence, and the decision made of it."""
