# Images for x86-64 and aarch64 (Raspberry Pi, Jetson) under one name, by buildx:
#
#     docker buildx bake -f deploy/docker/bake.hcl --push --set factorbus.tags=registry.example/factorbus:0.1
#     docker buildx bake -f deploy/docker/bake.hcl native
#
# The first pushes both, since only a registry keeps several under one name; the second builds that of this machine into
# its own store.  In the image for another processor no kernel is compiled: its first start does that, into its volume.
group "default" {
  targets = ["factorbus"]
}

target "factorbus" {
  context    = "."
  dockerfile = "deploy/docker/Dockerfile"
  tags       = ["factorbus:latest"]
  platforms  = ["linux/amd64", "linux/arm64"]
}

target "native" {
  inherits  = ["factorbus"]
  platforms = []
  output    = ["type=docker"]
}
