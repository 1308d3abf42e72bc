package main

import (
	"context"
	"encoding/json"
	"errors"
	"fmt"
	"log"
	"os"
	"path/filepath"

	resourceapi "k8s.io/api/resource/v1"
	"k8s.io/apimachinery/pkg/types"
	"k8s.io/client-go/kubernetes"
	"k8s.io/client-go/tools/clientcmd"
	"k8s.io/dynamic-resource-allocation/kubeletplugin"
	"k8s.io/dynamic-resource-allocation/resourceslice"
)

const (
	driverName = "gpu.nvidia.com"
	cdiKind    = "k8s.fake-gpu/claim"
)

// driver is the DRA driver. It publishes the node's GPUs as one pool, and describes what a claim got as CDI devices.
type driver struct {
	cdi    string
	cancel context.CancelCauseFunc
}

func serveDriver(ctx context.Context, given options) error {
	config, err := clientcmd.BuildConfigFromFlags("", given.kubeconfig)
	if err != nil {
		return err
	}
	client, err := kubernetes.NewForConfig(config)
	if err != nil {
		return err
	}
	data := filepath.Join(given.kubelet, "plugins", driverName)
	registry := filepath.Join(given.kubelet, "plugins_registry")
	for _, folder := range []string{data, registry, given.cdi} {
		if err := os.MkdirAll(folder, 0o750); err != nil {
			return err
		}
	}
	ctx, cancel := context.WithCancelCause(ctx)
	defer cancel(nil)
	helper, err := kubeletplugin.Start(ctx, &driver{cdi: given.cdi, cancel: cancel},
		kubeletplugin.DriverName(driverName), kubeletplugin.KubeClient(client), kubeletplugin.NodeName(given.node),
		kubeletplugin.PluginDataDirectoryPath(data), kubeletplugin.RegistrarDirectoryPath(registry))
	if err != nil {
		return fmt.Errorf("the DRA driver does not start: %w", err)
	}
	defer helper.Stop()
	if err := helper.PublishResources(ctx, resources(given)); err != nil {
		return fmt.Errorf("the GPUs can't be published: %w", err)
	}
	<-ctx.Done()
	return context.Cause(ctx)
}

func resources(given options) resourceslice.DriverResources {
	devices := make([]resourceapi.Device, 0, given.gpus)
	for gpu := range given.gpus {
		id, index := uuid(gpu), int64(gpu)
		kind := "gpu"
		devices = append(devices, resourceapi.Device{
			Name: fmt.Sprintf("gpu-%d", gpu),
			Attributes: map[resourceapi.QualifiedName]resourceapi.DeviceAttribute{
				"uuid": {StringValue: &id}, "index": {IntValue: &index}, "type": {StringValue: &kind},
			},
		})
	}
	slices := []resourceslice.Slice{{Devices: devices}}
	return resourceslice.DriverResources{Pools: map[string]resourceslice.Pool{given.node: {Slices: slices}}}
}

func (d *driver) PrepareResourceClaims(_ context.Context, claims []*resourceapi.ResourceClaim) (map[types.UID]kubeletplugin.PrepareResult, error) {
	prepared := map[types.UID]kubeletplugin.PrepareResult{}
	for _, claim := range claims {
		devices, err := d.prepare(claim)
		prepared[claim.UID] = kubeletplugin.PrepareResult{Devices: devices, Err: err}
	}
	return prepared, nil
}

func (d *driver) prepare(claim *resourceapi.ResourceClaim) ([]kubeletplugin.Device, error) {
	var prepared []kubeletplugin.Device
	var described []any
	for _, result := range claim.Status.Allocation.Devices.Results {
		if result.Driver != driverName {
			continue
		}
		var gpu int
		if _, err := fmt.Sscanf(result.Device, "gpu-%d", &gpu); err != nil {
			return nil, fmt.Errorf("no GPU is called %s", result.Device)
		}
		name := fmt.Sprintf("%s-%d", claim.UID, gpu)
		described = append(described, map[string]any{"name": name, "containerEdits": map[string]any{
			// As NVIDIA's: the hook of its container runtime must add nothing to what CDI has given.
			"env":         []string{"NVIDIA_VISIBLE_DEVICES=void"},
			"deviceNodes": []any{map[string]any{"path": deviceNode(gpu), "hostPath": hostDevice, "permissions": "rw"}},
		}})
		prepared = append(prepared, kubeletplugin.Device{
			Requests: []string{result.Request}, PoolName: result.Pool, DeviceName: result.Device,
			CDIDeviceIDs: []string{cdiKind + "=" + name},
		})
	}
	content, err := json.Marshal(map[string]any{"cdiVersion": "0.5.0", "kind": cdiKind, "devices": described})
	if err != nil {
		return nil, err
	}
	return prepared, replaceFile(d.file(claim.UID), content)
}

func (d *driver) UnprepareResourceClaims(_ context.Context, claims []kubeletplugin.NamespacedObject) (map[types.UID]error, error) {
	undone := map[types.UID]error{}
	for _, claim := range claims {
		err := os.Remove(d.file(claim.UID))
		if os.IsNotExist(err) {
			err = nil
		}
		undone[claim.UID] = err
	}
	return undone, nil
}

func (d *driver) HandleError(_ context.Context, err error, message string) {
	log.Printf("fake-gpu: %s: %v", message, err)
	if !errors.Is(err, kubeletplugin.ErrRecoverable) {
		d.cancel(err)
	}
}

// file describes the devices of one claim for the container engine.
func (d *driver) file(claim types.UID) string {
	return filepath.Join(d.cdi, fmt.Sprintf("fake-gpu-%s.json", claim))
}
