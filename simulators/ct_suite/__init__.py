"""A simulated CT suite: Hounsfield volumes of the scene as DICOM series."""
