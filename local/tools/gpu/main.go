// fake-gpu stands in for NVIDIA's device plugin and for its DRA driver, on a node without a GPU: it hands out /dev/null under the names
// of GPU devices. So the scheduler, the kubelet and the container engine do what they do with real ones, and each container shows
// what it got.
package main

import (
	"context"
	"errors"
	"flag"
	"fmt"
	"log"
	"os"
	"os/signal"
	"path/filepath"
	"syscall"
)

// The device that exists on every node, in place of a GPU's.
const hostDevice = "/dev/null"

type options struct {
	resource   string
	gpus       int
	replicas   int
	kubelet    string
	kubeconfig string
	node       string
	cdi        string
}

func main() {
	var given options
	flag.StringVar(&given.resource, "resource", "nvidia.com/gpu", "the resource of the device plugin; empty: no device plugin")
	flag.IntVar(&given.gpus, "gpus", 4, "GPUs of the node")
	flag.IntVar(&given.replicas, "replicas", 1, "how many containers share a GPU (time-slicing)")
	flag.StringVar(&given.kubelet, "kubelet-root", "/var/lib/kubelet", "the root folder of the kubelet, for the DRA driver")
	flag.StringVar(&given.kubeconfig, "kubeconfig", "", "how the DRA driver contacts the API server; empty: no DRA driver")
	flag.StringVar(&given.node, "node", "", "the node's name, for the DRA driver")
	flag.StringVar(&given.cdi, "cdi", "/var/run/cdi", "where the DRA driver describes its devices for the container engine")
	flag.Parse()
	ctx, stop := signal.NotifyContext(context.Background(), syscall.SIGINT, syscall.SIGTERM)
	defer stop()
	if err := run(ctx, given); err != nil && !errors.Is(err, context.Canceled) {
		log.Print("fake-gpu: ", err)
		os.Exit(1)
	}
}

func run(ctx context.Context, given options) error {
	ended := make(chan error, 2)
	parts := 0
	if given.resource != "" {
		parts++
		go func() { ended <- servePlugin(ctx, newPlugin(given.resource, given.gpus, given.replicas)) }()
	}
	if given.kubeconfig != "" {
		parts++
		go func() { ended <- serveDriver(ctx, given) }()
	}
	if parts == 0 {
		return errors.New("nothing to serve: give -resource, -kubeconfig or both")
	}
	return <-ended
}

// deviceNode is the path in a container of the GPU with this index.
func deviceNode(gpu int) string { return fmt.Sprintf("/dev/nvidia%d", gpu) }

// uuid is the name by which NVIDIA's programs know the GPU with this index.
func uuid(gpu int) string { return fmt.Sprintf("GPU-00000000-0000-0000-0000-%012d", gpu) }

func replaceFile(path string, content []byte) error {
	temporary := filepath.Join(filepath.Dir(path), "."+filepath.Base(path))
	if err := os.WriteFile(temporary, content, 0o644); err != nil {
		return err
	}
	return os.Rename(temporary, path)
}
