package main

import (
	"context"
	"fmt"
	"net"
	"os"
	"path/filepath"
	"sort"
	"strings"
	"time"

	"google.golang.org/grpc"
	"google.golang.org/grpc/credentials/insecure"
	api "k8s.io/kubelet/pkg/apis/deviceplugin/v1beta1"
)

// plugin is the device plugin. Like NVIDIA's it offers each GPU as often as it may be shared, passes the GPUs' UUIDs in
// NVIDIA_VISIBLE_DEVICES (its strategy `envvar`), and prefers the GPU that is used least.
type plugin struct {
	api.UnimplementedDevicePluginServer
	resource string
	// id -> index of its GPU
	devices  map[string]int
	replicas int
}

func newPlugin(resource string, gpus, replicas int) *plugin {
	made := &plugin{resource: resource, devices: map[string]int{}, replicas: replicas}
	for gpu := range gpus {
		for replica := range replicas {
			id := uuid(gpu)
			if replicas > 1 {
				id = fmt.Sprintf("%s::%d", id, replica)
			}
			made.devices[id] = gpu
		}
	}
	return made
}

func (p *plugin) GetDevicePluginOptions(context.Context, *api.Empty) (*api.DevicePluginOptions, error) {
	return &api.DevicePluginOptions{GetPreferredAllocationAvailable: true}, nil
}

func (p *plugin) ListAndWatch(_ *api.Empty, stream grpc.ServerStreamingServer[api.ListAndWatchResponse]) error {
	list := make([]*api.Device, 0, len(p.devices))
	for id := range p.devices {
		list = append(list, &api.Device{ID: id, Health: api.Healthy})
	}
	if err := stream.Send(&api.ListAndWatchResponse{Devices: list}); err != nil {
		return err
	}
	<-stream.Context().Done()
	return nil
}

func (p *plugin) GetPreferredAllocation(_ context.Context, asked *api.PreferredAllocationRequest) (*api.PreferredAllocationResponse, error) {
	answer := &api.PreferredAllocationResponse{}
	for _, one := range asked.ContainerRequests {
		ids := p.leastUsed(one.AvailableDeviceIDs, one.MustIncludeDeviceIDs, int(one.AllocationSize))
		answer.ContainerResponses = append(answer.ContainerResponses, &api.ContainerPreferredAllocationResponse{DeviceIDs: ids})
	}
	return answer, nil
}

// leastUsed chooses among the available devices, one after the other, that of the GPU with the most of them left.
func (p *plugin) leastUsed(available, must []string, size int) []string {
	chosen := append([]string{}, must...)
	taken := map[string]bool{}
	for _, id := range must {
		taken[id] = true
	}
	for len(chosen) < size {
		free := map[int][]string{}
		for _, id := range available {
			if !taken[id] {
				free[p.devices[id]] = append(free[p.devices[id]], id)
			}
		}
		best := -1
		for gpu, ids := range free {
			if best < 0 || len(ids) > len(free[best]) || len(ids) == len(free[best]) && gpu < best {
				best = gpu
			}
		}
		if best < 0 {
			break
		}
		sort.Strings(free[best])
		taken[free[best][0]] = true
		chosen = append(chosen, free[best][0])
	}
	return chosen
}

func (p *plugin) Allocate(_ context.Context, asked *api.AllocateRequest) (*api.AllocateResponse, error) {
	answer := &api.AllocateResponse{}
	for _, one := range asked.ContainerRequests {
		given := &api.ContainerAllocateResponse{}
		var uuids []string
		for _, id := range one.DevicesIds {
			gpu, known := p.devices[id]
			if !known {
				return nil, fmt.Errorf("%s has no device %s", p.resource, id)
			}
			uuids = append(uuids, uuid(gpu))
			given.Devices = append(given.Devices, &api.DeviceSpec{HostPath: hostDevice, ContainerPath: deviceNode(gpu), Permissions: "rw"})
		}
		given.Envs = map[string]string{"NVIDIA_VISIBLE_DEVICES": strings.Join(uuids, ",")}
		answer.ContainerResponses = append(answer.ContainerResponses, given)
	}
	return answer, nil
}

func (p *plugin) PreStartContainer(context.Context, *api.PreStartContainerRequest) (*api.PreStartContainerResponse, error) {
	return &api.PreStartContainerResponse{}, nil
}

// servePlugin serves the plugin and registers it, again whenever the kubelet has started anew: that removes the plugins' sockets.
func servePlugin(ctx context.Context, p *plugin) error {
	socket := filepath.Join(api.DevicePluginPath, "fake-gpu.sock")
	for {
		if err := os.Remove(socket); err != nil && !os.IsNotExist(err) {
			return err
		}
		listener, err := net.ListenUnix("unix", &net.UnixAddr{Name: socket, Net: "unix"})
		if err != nil {
			return fmt.Errorf("the device plugin can't listen at %s: %w", socket, err)
		}
		// What stays shows that the kubelet's folder has traces to be removed.
		listener.SetUnlinkOnClose(false)
		server := grpc.NewServer()
		api.RegisterDevicePluginServer(server, p)
		go func() { _ = server.Serve(listener) }()
		err = register(ctx, p, filepath.Base(socket))
		if err == nil {
			err = awaitRemoval(ctx, socket)
		}
		server.Stop()
		if err != nil {
			return err
		}
	}
}

func register(ctx context.Context, p *plugin, endpoint string) error {
	connection, err := grpc.NewClient("unix://"+api.KubeletSocket, grpc.WithTransportCredentials(insecure.NewCredentials()))
	if err != nil {
		return err
	}
	defer func() { _ = connection.Close() }()
	limited, cancel := context.WithTimeout(ctx, 30*time.Second)
	defer cancel()
	request := &api.RegisterRequest{
		Version: api.Version, Endpoint: endpoint, ResourceName: p.resource,
		Options: &api.DevicePluginOptions{GetPreferredAllocationAvailable: true},
	}
	if _, err := api.NewRegistrationClient(connection).Register(limited, request, grpc.WaitForReady(true)); err != nil {
		return fmt.Errorf("the kubelet does not register the device plugin of %s: %w", p.resource, err)
	}
	return nil
}

// awaitRemoval returns once the kubelet has removed the socket.
func awaitRemoval(ctx context.Context, socket string) error {
	tick := time.NewTicker(time.Second)
	defer tick.Stop()
	for {
		select {
		case <-ctx.Done():
			return ctx.Err()
		case <-tick.C:
			if _, err := os.Stat(socket); os.IsNotExist(err) {
				return nil
			}
		}
	}
}
