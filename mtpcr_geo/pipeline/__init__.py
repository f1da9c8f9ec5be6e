"""The one engine: stages named by JSON, wired and run."""
