"""The second copy of the artefacts in an object store: interface, adapter, uploader, cache, freeing of the spool."""
