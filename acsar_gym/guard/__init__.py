"""What stops the wheels when programs don't: watchdog, shutdown, emergency stop."""
