"""The command line: one module a topic; each command is a thin face over a public function."""
