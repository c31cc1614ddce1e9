"""From file to file: what the commands do, without a word to the user. Its parts are imported when they are used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "evaluate": ["run_evaluation"],
        "files": ["load_reference", "load_scan", "summary"],
        "reconstruct": ["ReconstructionJob", "profile_report", "run_reconstruction"],
        "simulate": [
            "SimulationJob",
            "refuse_jitter",
            "refuse_noise_options",
            "run_simulation",
        ],
    },
)
