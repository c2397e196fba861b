"""The stand-alone commands on public data sets."""
