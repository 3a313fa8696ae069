"""Command-line programs, each thin: options in, the library called, progress shown."""
