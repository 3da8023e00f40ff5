"""What a bench endures, as processes of its own seen from outside: hours, strangers, and being killed. `runs` first."""
