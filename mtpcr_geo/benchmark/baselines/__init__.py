"""Other people's methods, run under the same protocol as ours."""
