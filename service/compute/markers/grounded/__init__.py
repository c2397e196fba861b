"""The paper's detection chain with its networks: boxes by Grounding DINO, masks by SAM 2, outlines by our edges."""
