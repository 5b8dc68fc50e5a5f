"""Environments for other libraries: ``gymnasium_env``, ``stable_baselines3``, ``dm_env``, ``torch_function``.

Each module needs the library in its name; an extra installs it: ``pip install 'rewax[gymnasium]'``. Gradients pass
through ``torch_function`` only. The other modules return NumPy arrays.
"""
