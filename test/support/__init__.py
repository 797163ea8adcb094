"""What tests share: arms, recordings, nodes and peers to talk to, other libraries' answers."""
