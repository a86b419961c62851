"""Mutants of the data: windows, ranks, predictors, streams."""

from .mutant import Mutant as M

HANKEL, STREAM, KNOWN = "data/test_hankel.py", "data/test_stream.py", "attacks/test_partial_knowledge.py -k predict"

MUTANTS = [
    M(
        "Hankel rows channel-major",
        "torch_dpc/data/recordings.py",
        "windows.permute(2, 1, 0)",
        "windows.permute(1, 2, 0)",
        HANKEL,
    ),
    M(
        "a window of one sample less",
        "torch_dpc/data/recordings.py",
        "windows = w.unfold(0, depth, 1)",
        "windows = w[:-1].unfold(0, depth, 1)",
        HANKEL,
    ),
    M(
        "the past one channel short",
        "torch_dpc/data/hankel.py",
        "cut_u, cut_y = t_ini * n_u, t_ini * n_y",
        "cut_u, cut_y = t_ini * n_u, t_ini * n_y - 1",
        HANKEL,
    ),
    M(
        "rank by an absolute cut-off",
        "torch_dpc/data/row_space.py",
        "_right_range(rows[:n_W], tolerance * largest)",
        "_right_range(rows[:n_W], tolerance * 1e9)",
        HANKEL,
    ),
    M(
        "channels keep their units for the rank",
        "torch_dpc/data/row_space.py",
        "for m in matrices]) / units[:, None]",
        "for m in matrices])",
        HANKEL,
    ),
    M(
        "row space not orthogonalised again",
        "torch_dpc/data/row_space.py",
        "torch.linalg.qr(in_rest - in_W @ (in_W.T @ in_rest)).Q",
        "in_rest",
        "data/test_hankel.py -k basis",
    ),
    M(
        "remainder of Yf keeps W",
        "torch_dpc/data/row_space.py",
        "remainder = rows[n_W:] - (rows[n_W:] @ in_W) @ in_W.T",
        "remainder = rows[n_W:]",
        HANKEL,
    ),
    M(
        "excitation one depth too low",
        "torch_dpc/data/rank.py",
        "else (low, middle - 1)",
        "else (low, middle - 2)",
        HANKEL + " -k excitation",
    ),
    M(
        "predictor from the whole row space",
        "torch_dpc/data/predictor.py",
        "basis = space.basis[:, : space.rank_W]",
        "basis = space.basis",
        KNOWN,
    ),
]
