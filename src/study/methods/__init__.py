"""Registration methods behind one verb (sec. IV)."""
