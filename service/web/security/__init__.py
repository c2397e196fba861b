"""Who may do what: sign-in, permissions, safety headers and the sealed record."""
