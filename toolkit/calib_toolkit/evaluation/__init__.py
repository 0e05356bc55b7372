"""The paper's experiments (section VIII) on recordings whose truth is known: ``calib-toolkit evaluate``.

``protocols`` says what each experiment is, ``drives`` opens the recordings, ``sections`` draws the random parts,
``experiment`` runs them all and ``store`` keeps what is finished; ``summary`` and ``figures`` show it.
"""
