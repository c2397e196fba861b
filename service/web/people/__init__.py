"""Accounts, sign-in, roles and badges."""
