"""Command-line programs. Each module imports what it needs when it runs, so that errors come fast."""
