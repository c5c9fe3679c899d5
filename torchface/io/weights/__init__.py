"""Blendshape weights as files and as packets: plain CSV, Live Link Face, OSC."""

from torchface.io.weights.live_link_csv import save_live_link
from torchface.io.weights.live_link_stream import LiveLinkFrame, decode_frame, encode_frame
from torchface.io.weights.weight_senders import WeightSender, open_sender

__all__ = ["LiveLinkFrame", "WeightSender", "decode_frame", "encode_frame", "open_sender", "save_live_link"]
