"""Grounding DINO and SAM 2 with few random weights, in folders as Hugging Face publishes them."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

_WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "spheres", "sphere", "ball")
_HIDDEN = 32


def tiny_weights(folder: Path) -> Path:
    """Write both models into a folder: 0.4 million parameters, drawn at random with a fixed seed."""
    torch = importlib.import_module("torch")
    torch.manual_seed(7)
    _grounding_dino(folder / "grounding-dino")
    _sam2(folder / "sam2")
    return folder


def _grounding_dino(folder: Path) -> None:
    transformers = importlib.import_module("transformers")
    tokenizers = importlib.import_module("tokenizers")
    words = transformers.BertConfig(
        vocab_size=len(_WORDS), hidden_size=_HIDDEN, num_hidden_layers=1, num_attention_heads=2, intermediate_size=32
    )
    pixels = transformers.SwinConfig(
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 2, 2],
        window_size=4,
        out_features=["stage2", "stage3", "stage4"],
    )
    config = transformers.GroundingDinoConfig(
        backbone_config=pixels,
        text_config=words,
        d_model=_HIDDEN,
        num_queries=20,
        encoder_layers=1,
        decoder_layers=2,
        encoder_ffn_dim=32,
        decoder_ffn_dim=32,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        max_text_len=16,
    )
    transformers.GroundingDinoForObjectDetection(config).save_pretrained(folder)
    model = tokenizers.Tokenizer(
        tokenizers.models.WordPiece({word: k for k, word in enumerate(_WORDS)}, unk_token="[UNK]")
    )
    model.normalizer = tokenizers.normalizers.BertNormalizer()
    model.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    model.post_processor = tokenizers.processors.BertProcessing(("[SEP]", 3), ("[CLS]", 2))
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=model, unk_token="[UNK]", pad_token="[PAD]", cls_token="[CLS]", sep_token="[SEP]"
    ).save_pretrained(folder)
    size = {"shortest_edge": 160, "longest_edge": 240}
    (folder / "preprocessor_config.json").write_text(
        json.dumps({"image_processor_type": "GroundingDinoImageProcessor", "size": size})
    )


def _sam2(folder: Path) -> None:
    transformers = importlib.import_module("transformers")
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[128, 128],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 2, 2],
        window_size_per_stage=[4, 4, 4, 4],
        global_attention_blocks=[3],  # never the first block of a stage, which pools
    )
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
        fpn_hidden_size=_HIDDEN,
    )
    config = transformers.Sam2Config(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": _HIDDEN, "image_size": 128, "mask_input_channels": 4},
        mask_decoder_config={
            "hidden_size": _HIDDEN, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 32,
        },
    )  # fmt: skip
    transformers.Sam2Model(config).save_pretrained(folder)
