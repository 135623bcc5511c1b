"""One subcommand each: its options, the function it calls, what it prints."""
