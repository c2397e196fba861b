"""Device drivers behind the interfaces in drivers.interfaces: each a file or a folder here, named by an entry point.

What several drivers share is in folders of its own: host (a driver's process), photos and meshes (their files).
"""
