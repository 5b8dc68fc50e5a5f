"""Environments as other libraries want them: ``gymnasium_env``, ``dm_env``, ``torch_function``.

Each needs the library it is named after, which an extra of the same name brings: ``pip install 'rewax[gymnasium]'``.
Gradients pass through ``torch_function`` alone; the others hand out NumPy arrays.
"""
