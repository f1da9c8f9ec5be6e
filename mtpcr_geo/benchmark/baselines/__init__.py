"""Published methods of others, run under the same protocol as the registration."""
